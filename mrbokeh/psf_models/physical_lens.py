"""PHYSICALLENS: light traced through the surfaces of a real lens; coordinates are depth and eccentricity (Leimkuehler 2018, 5.1).

Cat's eyes (rims that cut the beam off the axis), aberrations and colour fringes are not modelled but happen: every ray is
refracted by Snell's law at every surface, with the index at its wavelength.

Left out: reflections between surfaces, diffraction and the light that coatings lose.
"""

from collections.abc import Iterable
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float64

from mrbokeh.optics.psf_bank import Axis, Turns
from mrbokeh.psf_models import _physical_lens_numba as compiled
from mrbokeh.psf_models._lens_beam import GREEN_UM, LensBeam, area_of
from mrbokeh.psf_models.base import Kernel, centred, check_positive, digest, sobol_blocks
from mrbokeh.psf_models.lens_prescription import LensPrescription
from mrbokeh.psf_models.lens_prescription_file import biconvex_lens, read_prescription
from mrbokeh.system.errors import InputError

EXPONENTS = (2.5, 1.2)
COUNTS = (554, 554)
"""Steps along depth and eccentricity that give the 4,000 cells of the paper's Table 1."""

_LARGEST_RADIUS_PX = 1024
_Through = tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray]


class PhysicalLens:
    """Lens by its prescription in front of a sensor; without one the paper's bi-convex lens (`biconvex_lens`).

    The source of a kernel's light is where its chief ray (green, through the middle of the stop) meets the sensor, so that
    distortion is no part of the blur, and red and blue are displaced as the lens's lateral colour has them. Eccentricity is
    the distance of that place from the middle of the frame in half diagonals; depth counts from the front principal plane.

    prescription: itself or a file of surfaces. focus_distance_m: the sensor is moved to where the paraxial green image of
    this distance lies. f_number: closes the iris, None leaves it open. sensor_mm: width and height. nearest_m, farthest_m: range
    of depth of a bank. vignetting: a kernel sums to the open share of its beam (`throughput`), not to 1. counts: steps of
    the nested grid along depth and eccentricity.
    The range of eccentricity ends where the lens goes black if that is before the corner.
    """

    name = "physical"
    knee_px: float | None = None
    turns: Turns = "field"
    channels = 3
    near_side_turned = False
    default_rays = 1 << 18

    def __init__(
        self,
        prescription: LensPrescription | Path | str | None = None,
        *,
        focus_distance_m: float = 2.0,
        f_number: float | None = None,
        sensor_mm: tuple[float, float] = (36.0, 24.0),
        image_width_px: int = 1024,
        nearest_m: float = 0.5,
        farthest_m: float = 100.0,
        vignetting: bool = True,
        counts: tuple[int, ...] = COUNTS,
        device: str = "",
    ) -> None:
        lens = read_prescription(prescription) if isinstance(prescription, (Path, str)) else prescription or biconvex_lens()
        self.lens = lens if f_number is None else lens.stopped_down(f_number)
        self.focus_distance_m, self.vignetting, self.counts, self.device = focus_distance_m, vignetting, counts, device
        width_mm, height_mm = (check_positive("the sensor's width and height in mm", size) for size in sensor_mm)
        self.mm_per_px = width_mm / check_positive("the picture's width in pixels", float(image_width_px))
        self._depth = Axis("depth_m", check_positive("the nearest depth", nearest_m), farthest_m, EXPONENTS[0])
        sensor_at_mm = self.lens.paraxial_at(GREEN_UM).sensor_mm(focus_distance_m)
        if not sensor_at_mm > self.lens.vertices_mm[-1]:
            raise InputError(f"{self.lens.name} forms its image inside its own glass: no sensor fits there")
        self.beam = LensBeam(self.lens, sensor_at_mm, 0.5 * float(np.hypot(width_mm, height_mm)))
        self._ends_per_mm = self._per_mm(np.array([nearest_m, farthest_m]))

    @cached_property
    def axes(self) -> tuple[Axis, ...]:
        return self._depth, Axis("eccentricity", 0.0, self.beam.lit_up_to(self._ends_per_mm), EXPONENTS[1])

    @property
    def settings(self) -> dict[str, Any]:
        return {
            "prescription": self.lens.name,
            "surfaces": digest(self.beam.table),
            "focal_length_mm": round(self.lens.focal_length_mm, 4),
            "f_number": round(self.lens.f_number, 4),
            "focus_distance_m": str(self.focus_distance_m) if np.isinf(self.focus_distance_m) else self.focus_distance_m,
            "half_diagonal_mm": self.beam.half_diagonal_mm,
            "mm_per_px": self.mm_per_px,
            "vignetting": self.vignetting,
        }

    def exact(self, coords: Float64[np.ndarray, " axes"]) -> Kernel | None:  # noqa: ARG002
        """Return None: there is no closed form."""
        return None

    def kernel(self, box: Float64[np.ndarray, "axes 2"], rays: int, seed: int) -> Kernel:
        """See `PsfModel.kernel`. Each of the rays is traced in three colours, its wavelengths spread over their bands."""
        if rays <= 0:
            raise InputError("a physical lens has no closed form: expected at least one ray")
        return self._of_known_light(self.landed(box, rays, sobol_blocks(5, rays, seed, self.device)), rays)

    def landed(
        self, box: Float64[np.ndarray, "axes 2"], rays: int, blocks: Iterable[Float64[np.ndarray, "rays 5"]]
    ) -> Float64[np.ndarray, "size size 3"]:
        """Return what this many rays bring to the sensor, relative to the light on the axis.

        blocks: shares in [0, 1) of the window (meridional and across), of the band of wavelengths, of the range of depth and of
        eccentricity.
        """
        chiefs = self.beam.chief_rays(*box[1].tolist())
        ends = self._per_mm(np.unique(box[0]))[::-1]
        window = self.beam.window(ends, np.unique(np.append(box[1], box[1].mean())))
        areas_mm2 = np.array([self.beam.area_mm2(end, 0.0) for end in ends.tolist()])
        kernel, add = np.zeros((1, 1, 3)), self._added_on_device if self.device else self._added
        for shares in blocks:
            per_mm = self._per_mm(self._depth.between(box[0, 0], box[0, 1], shares[:, 3]))
            light = area_of(window) / rays / np.interp(per_mm, ends, areas_mm2)
            kernel = add(kernel, (chiefs, window, shares[:, :3], per_mm, shares[:, 4] * (len(chiefs) - 1)), light)
        return kernel

    def _added(self, kernel: np.ndarray, through: _Through, light: Float64[np.ndarray, " rays"]) -> np.ndarray:
        """Return the kernel, widened if needed, with rays added; through: what `LensBeam.trace` takes."""
        landings, weights = self.beam.trace(*through)
        weights *= light[:, None]
        kernel = self._wide_enough(kernel, float(np.abs(landings[weights > 0.0]).max(initial=0.0)))
        compiled.add_landings(kernel, landings, weights, self.mm_per_px)
        return kernel

    def _added_on_device(self, kernel: np.ndarray, through: _Through, light: Float64[np.ndarray, " rays"]) -> np.ndarray:
        from mrbokeh.psf_models.torch_tracing import LandedRays

        rays = LandedRays(self.device, self.beam, *through, light)
        kernel = self._wide_enough(kernel, rays.reach_mm)
        return kernel + rays.picture(len(kernel), self.mm_per_px)

    def throughput(self, depth_m: float, eccentricity: float) -> float:
        """Return the open share: cross-section of the beam across the axis that reaches the sensor, relative to the beam on the axis.

        It is what rims take away (mechanical vignetting), without the natural fall of light by cos^4. Above 1 where the
        pupil of a wide-angle lens turns towards the field and grows; kernels sum to at most 1.
        """
        return self.beam.open_share(float(self._per_mm(np.array(depth_m))), float(eccentricity))

    def _of_known_light(self, kernel: Float64[np.ndarray, "size size 3"], rays: int) -> Kernel:
        """Scale all colours to one sum: red, green and blue are the brightness of the light that arrives, not of the glass."""
        light = kernel.sum(axis=(0, 1))
        if not light.min() > 0.0:
            raise InputError(f"none of {rays} rays came through {self.lens.name}: trace more of them")
        share = min(1.0, float(light.mean())) if self.vignetting else 1.0
        return (kernel * (share / light)).astype(np.float32)

    def _per_mm(self, depth_m: Float64[np.ndarray, "*batch"]) -> Float64[np.ndarray, "*batch"]:
        least_m = max(self.beam.front_mm, 0.0) / 1000.0 + 0.001 * self.lens.surfaces[0].diameter_mm
        if not (np.asarray(depth_m) > least_m).all():
            raise InputError(f"expected depths in front of the lens, more than {least_m:.4g} m, got {np.min(depth_m):g} m")
        return np.asarray(0.001 / np.asarray(depth_m, np.float64))

    def _wide_enough(self, kernel: np.ndarray, reach_mm: float) -> np.ndarray:
        radius = int(np.ceil(reach_mm / self.mm_per_px + 0.5))
        if radius > _LARGEST_RADIUS_PX:
            raise InputError(f"light lands {radius} px from its source: choose a nearest depth farther off or fewer pixels")
        return kernel if 2 * radius + 1 <= len(kernel) else centred(kernel, 2 * radius + 1)
