"""PHYSICALLENS: light traced through the surfaces of a real lens; coordinates are depth and eccentricity (Leimkuehler 2018, 5.1).

Cat's eyes (rims that cut the beam off the axis), aberrations and colour fringes are not modelled but happen: every ray is
refracted by Snell's law at every surface, with the index at its wavelength. Left out: reflections between surfaces, diffraction and
the light that coatings lose. Lenses are read from the tables in which lens designs are published; the simplest one is a formula.
"""

from collections.abc import Iterable
from dataclasses import replace
from functools import cached_property
from math import inf, sqrt
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float64

from mrbokeh.optics.lens import Lens
from mrbokeh.optics.lens_file import stated_facts
from mrbokeh.optics.lens_library import shipped
from mrbokeh.optics.psf_bank import Axis, Turns
from mrbokeh.psf_models import _physical_lens_numba as compiled
from mrbokeh.psf_models._lens_beam import GREEN_UM, LensBeam, area_of
from mrbokeh.psf_models.base import Kernel, centred, check_positive, digest, sobol_blocks
from mrbokeh.psf_models.lens_description import Bench
from mrbokeh.psf_models.lens_prescription import LensPrescription, Surface, estimated_abbe_number
from mrbokeh.system.atomic_files import read_json
from mrbokeh.system.errors import InputError


def biconvex_lens(
    focal_length_mm: float = 50.0, f_number: float = 4.0, edge_mm: float = 1.0, index: float = 1.5168, abbe_number: float = 64.17
) -> LensPrescription:
    """Return the bi-convex spherical lens of Leimkuehler et al. 2018: two equal radii, by default of BK7, no iris but its rims.

    The paper states no numbers. Radius R and thickness t follow from the thick lensmaker's formula
    1/f = (n - 1)(2/R - (n - 1) t / (n R^2)) with t just leaving `edge_mm` at the rim.
    """
    semi_mm, thickness_mm, radius_mm = 0.5 * focal_length_mm / f_number, 0.0, 0.0
    for _ in range(50):
        if thickness_mm >= index * focal_length_mm or radius_mm < 0.0:
            break
        radius_mm = focal_length_mm * (index - 1.0) * (1.0 + sqrt(1.0 - thickness_mm / (index * focal_length_mm)))
        if radius_mm <= semi_mm:
            raise InputError(f"one bi-convex lens of index {index:g} cannot have f/{f_number:g}: choose a larger f-number")
        thickness_mm = edge_mm + 2.0 * (radius_mm - sqrt(radius_mm**2 - semi_mm**2))
    front = Surface(radius_mm=radius_mm, distance_mm=thickness_mm, index=index, diameter_mm=2.0 * semi_mm, abbe_number=abbe_number)
    return LensPrescription("biconvex", (front, Surface(-radius_mm, 0.0, 1.0, 2.0 * semi_mm)))


_COLUMNS = "radius, distance to the next surface, index behind it, [Abbe number,] aperture diameter, in mm"
_HALVINGS = 30


def read_prescription(path: Path | str) -> LensPrescription:
    """Read a table of surfaces from the scene to the sensor, one per line, `#` begins a comment.

    Columns, in mm: radius (0: the stop; inf: flat), distance to the next surface, index n_d behind it (0: as before),
    aperture diameter; with five columns the Abbe number stands before the aperture (the order of Kolb et al. 1995).
    Where it is missing it is estimated (mrbokeh.psf_models.lens_prescription). InputError names the line that is not understood.
    A name of the lens library, or a lens file that holds a prescription, gives that one.
    """
    path = shipped(path)
    if path.suffix.lower() == ".json":
        return _of_lens_file(path)
    try:
        lines = path.read_text(encoding="utf-8").splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(f"expected a table of lens surfaces ({_COLUMNS}) at {path}, but it cannot be read: {error}") from None
    rows = [(number, line.split("#")[0].split()) for number, line in enumerate(lines, 1)]
    rows = [(number, words) for number, words in rows if words]
    surfaces: list[Surface] = []
    for number, words in rows:
        try:
            surfaces.append(_surface(words, surfaces[-1].index if surfaces else 1.0, surfaces[-1].abbe_number if surfaces else inf))
        except InputError as error:
            raise InputError(f"{path}, line {number}: {error}") from None
    return with_estimated_abbe_numbers(LensPrescription(path.stem, tuple(surfaces)))


def _of_lens_file(path: Path) -> LensPrescription:
    document = read_json(path, "a lens file with a prescription")
    held = document.get("prescription") if isinstance(document, dict) else None
    rows = held.get("surfaces") if isinstance(held, dict) else None
    if not isinstance(rows, list) or not rows or not all(isinstance(row, list) for row in rows):
        raise InputError(f"expected a lens file with the surfaces of a prescription, as `mrbokeh lens list` names them, got {path} without")
    surfaces: list[Surface] = []
    for row in rows:
        words = ["inf" if each is None else repr(each) for each in row]
        surfaces.append(_surface(words, surfaces[-1].index if surfaces else 1.0, surfaces[-1].abbe_number if surfaces else inf))
    return with_estimated_abbe_numbers(LensPrescription(path.stem, tuple(surfaces)))


def _surface(words: list[str], index_before: float, abbe_before: float) -> Surface:
    try:
        numbers = [float(word) for word in words]
    except ValueError:
        raise InputError(f"expected numbers ({_COLUMNS}), got {' '.join(words)!r}") from None
    if len(numbers) not in (4, 5) or any(np.isnan(numbers)):
        raise InputError(f"expected 4 or 5 numbers ({_COLUMNS}), got {' '.join(words)!r}")
    radius_mm, distance_mm, index, diameter_mm = (*numbers[:3], numbers[-1])
    is_stop = radius_mm == 0.0 and index in (0.0, index_before)
    if radius_mm == 0.0 and not is_stop:
        raise InputError(f"a radius of 0 is the stop and cannot change the index to {index:g}: write a flat surface as inf")
    abbe = numbers[3] if len(numbers) == 5 and index not in (0.0, 1.0) else inf
    if index == 0.0:
        index, abbe = index_before, abbe_before
    return Surface(
        radius_mm=inf if is_stop else radius_mm,
        distance_mm=distance_mm,
        index=index,
        diameter_mm=diameter_mm,
        abbe_number=abbe,
        is_stop=is_stop,
    )


def with_estimated_abbe_numbers(lens: LensPrescription) -> LensPrescription:
    """Give glass (index above 1.01) without an Abbe number one by its index and the power (n - 1)(1/R1 - 1/R2) of its element.

    Designers bring blue and red to one focus. If glass from the edges of the Abbe diagram would do more than that, all
    estimates are moved from their edge towards the other one until no axial colour is left (`estimated_abbe_number`'s mix).
    Half way every index has one Abbe number, as for a single lens, which has too little correction: the solution lies before.
    """
    unknown = {i: _is_positive(lens.surfaces, i) for i, each in enumerate(lens.surfaces) if each.index > 1.01 and each.abbe_number == inf}

    def mixed(mix: float) -> LensPrescription:
        surfaces = list(lens.surfaces)
        for i, is_positive in unknown.items():
            surfaces[i] = replace(surfaces[i], abbe_number=estimated_abbe_number(surfaces[i].index, is_positive, mix))
        return replace(lens, surfaces=tuple(surfaces))

    low, high = 0.0, 0.5
    if not unknown or mixed(low).axial_colour_mm >= 0.0:
        return mixed(low)
    for _ in range(_HALVINGS):
        middle = 0.5 * (low + high)
        low, high = (low, middle) if mixed(middle).axial_colour_mm >= 0.0 else (middle, high)
    return mixed(high)


def _is_positive(surfaces: tuple[Surface, ...], i: int) -> bool:
    """Return whether the element that begins at surface i collects light."""
    front = next((before for before in surfaces[i::-1] if not before.is_stop), surfaces[i])
    back = next((behind for behind in surfaces[i + 1 :] if not behind.is_stop), surfaces[i])
    return front.curvature_per_mm >= back.curvature_per_mm


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
    the nested grid along depth and eccentricity. sharpest: the sensor stands where green light of a point at the focus distance is
    smallest, as a photographer focuses, instead.
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
        sharpest: bool = False,
        counts: tuple[int, ...] = COUNTS,
        device: str = "",
    ) -> None:
        lens = read_prescription(prescription) if isinstance(prescription, (Path, str)) else prescription or biconvex_lens()
        self.lens = lens if f_number is None else lens.stopped_down(f_number)
        self.focus_distance_m, self.vignetting, self.counts, self.device = focus_distance_m, vignetting, counts, device
        self.sharpest = sharpest
        width_mm, height_mm = (check_positive("the sensor's width and height in mm", size) for size in sensor_mm)
        self.stated = Lens(self.lens.focal_length_mm, self.lens.f_number, focus_distance_m, width_mm, sensor_height_mm=height_mm)
        self.mm_per_px = width_mm / check_positive("the picture's width in pixels", float(image_width_px))
        self._depth = Axis("depth_m", check_positive("the nearest depth", nearest_m), farthest_m, EXPONENTS[0])
        half_diagonal_mm = 0.5 * float(np.hypot(width_mm, height_mm))
        if sharpest:
            self.beam = Bench(self.lens, focus_distance_m, half_diagonal_mm).beam
        else:
            self.beam = LensBeam(self.lens, self.lens.paraxial_at(GREEN_UM).sensor_mm(focus_distance_m), half_diagonal_mm)
        if not self.beam.sensor_at_mm > self.lens.vertices_mm[-1]:
            raise InputError(f"{self.lens.name} forms its image inside its own glass: no sensor fits there")
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
            "lens": stated_facts(self.stated),
            "half_diagonal_mm": self.beam.half_diagonal_mm,
            "mm_per_px": self.mm_per_px,
            "vignetting": self.vignetting,
            **({"sharpest": True} if self.sharpest else {}),
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
