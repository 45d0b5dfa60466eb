"""VOLUME: light that a medium scatters on its way to the camera (Leimkuehler 2018, Section 5.1); the coordinate is the distance.

Model. A source that shines evenly into all directions sits in the middle of a ball of homogeneous medium; the camera, on its
surface, looks at the source. Every place on the ball sees the same, so no photon has to hit a small camera: each one that
leaves the ball counts, by the angle between its heading and the normal, which is the angle from the source under which the
camera sees it. Each collision multiplies its light by the albedo. Not in the model is light that passes the camera and comes
back: little, as the medium scatters forwards. A photon's light is what falls on a sensor that faces the source.
"""

from functools import cached_property
from typing import Any

import numpy as np
from jaxtyping import Float64, Int64

from mrbokeh.optics.psf_bank import Axis, Turns
from mrbokeh.psf_models import _rays_numba as compiled
from mrbokeh.psf_models.base import Kernel, check_positive, sobol_blocks
from mrbokeh.system.errors import InputError

SAMPLES = 200
EXPONENT = 1.0
DENSITY_PER_M, ANISOTROPY, ALBEDO = 0.9, 0.8, (1.0, 1.0, 0.9)
_RING_PX = 0.125


class Volume:
    """Homogeneous medium. The paper's density has no unit; here it is collisions per metre.

    anisotropy: Henyey-Greenstein's g, the mean cosine of a scattering angle, above -1 and below 1. albedo: share of light
    that a collision leaves, for red, green, blue. focal_px: pinhole focal length of the picture in pixels. farthest_m: range
    of a bank, from 0. size_px: width of the window (odd); the wide veil beyond it is left out and the rest scaled up, so
    that a channel without absorption sums to 1 and one with it to the share that is left.
    majorant_per_m: of Woodcock tracking, at least the density; only the time depends on it.
    """

    name = "volume"
    knee_px: float | None = None
    turns: Turns = "none"
    channels = 3
    near_side_turned = False
    default_rays = 1 << 20

    def __init__(
        self,
        *,
        density_per_m: float = DENSITY_PER_M,
        anisotropy: float = ANISOTROPY,
        albedo: tuple[float, float, float] = ALBEDO,
        focal_px: float = 1024.0,
        farthest_m: float = 5.0,
        size_px: int = 513,
        majorant_per_m: float | None = None,
        counts: tuple[int, ...] = (SAMPLES,),
        device: str = "",
    ) -> None:
        if not (np.isfinite(density_per_m) and density_per_m >= 0.0):
            raise InputError(f"the density of a medium must be a number of at least 0 per metre, got {density_per_m}")
        if not -1.0 < anisotropy < 1.0:
            raise InputError(f"the anisotropy must lie between -1 and 1, got {anisotropy}")
        if len(albedo) != 3 or not all(0.0 <= each <= 1.0 for each in albedo):
            raise InputError(f"expected three albedos from 0 to 1, got {albedo}")
        if size_px < 1 or size_px % 2 == 0:
            raise InputError(f"a window of odd width is needed, so that the source has a pixel, got {size_px}")
        self.density_per_m, self.anisotropy, self.albedo, self.size_px = density_per_m, anisotropy, albedo, size_px
        self.majorant_per_m = density_per_m if majorant_per_m is None else majorant_per_m
        if not density_per_m <= self.majorant_per_m < np.inf:
            raise InputError(f"the majorant must be at least the density {density_per_m} per metre, got {majorant_per_m}")
        self.focal_px, self._farthest_m = check_positive("the focal length in pixels", focal_px), farthest_m
        self.counts, self.device = counts, device

    @cached_property
    def axes(self) -> tuple[Axis, ...]:
        return (Axis("depth_m", 0.0, check_positive("the farthest distance", self._farthest_m), EXPONENT),)

    @property
    def settings(self) -> dict[str, Any]:
        return {
            "density_per_m": self.density_per_m,
            "anisotropy": self.anisotropy,
            "albedo": list(self.albedo),
            "focal_px": self.focal_px,
            "size_px": self.size_px,
            "majorant_per_m": self.majorant_per_m,
        }

    def exact(self, coords: Float64[np.ndarray, " axes"]) -> Kernel | None:
        """Return the point itself if there is no medium or no distance; else there is no closed form."""
        if self.density_per_m * float(coords[0]) == 0.0:
            return np.ones((1, 1, 3), np.float32)
        return None

    def kernel(self, box: Float64[np.ndarray, "axes 2"], rays: int, seed: int) -> Kernel:
        """Return the kernel; see `PsfModel.kernel`. Distances are quasi-random; the walks, of unbounded length, pseudo-random (seeded)."""
        if rays <= 0:
            raise InputError("scattering has no closed form: expected at least one ray")
        rings, albedo = self._rings(), np.array([*self.albedo, 1.0])
        first = 0
        for shares in sobol_blocks(1, rays, seed, self.device):
            distances_m = self.axes[0].between(box[0, 0], box[0, 1], shares[:, 0])
            if self.device:
                rings += self._rings_on_device(distances_m, seed, first, albedo)
            else:
                compiled.add_to_rings(rings, *self.trace(distances_m, seed, first), albedo, self.focal_px, _RING_PX)
            first += len(shares)
        kernel = np.zeros((self.size_px, self.size_px, 4))
        compiled.spread_rings(rings, _RING_PX, kernel)
        return self._of_known_light(_cut(kernel), rays)

    def trace(
        self, distances_m: Float64[np.ndarray, " rays"], seed: int, first: int = 0
    ) -> tuple[Float64[np.ndarray, " rays"], Int64[np.ndarray, " rays"]]:
        """Trace one photon (number `first` and following) for each distance: cosine of the angle from the source, and collisions."""
        cosines, collisions = np.empty(len(distances_m)), np.empty(len(distances_m), np.int64)
        medium = (self.density_per_m, self.majorant_per_m, self.anisotropy)
        compiled.trace_photons(first, seed, distances_m, *medium, cosines, collisions)
        return cosines, collisions

    def _rings_on_device(
        self, distances_m: Float64[np.ndarray, " rays"], seed: int, first: int, albedo: Float64[np.ndarray, "4"]
    ) -> Float64[np.ndarray, "rings 4"]:
        from mrbokeh.psf_models.torch_tracing import photons_in_rings, trace_photons

        medium = (self.density_per_m, self.majorant_per_m, self.anisotropy)
        photons = trace_photons(self.device, first, seed, distances_m, *medium)
        return photons_in_rings(*photons, albedo, self.focal_px, _RING_PX, len(self._rings()))

    def _rings(self) -> Float64[np.ndarray, "rings 4"]:
        """Return empty rings, as many as reach the corners of the window; the last channel loses nothing."""
        return np.zeros((int(np.ceil(self.size_px * np.sqrt(0.5) / _RING_PX)), 4))

    def _of_known_light(self, kernel: Float64[np.ndarray, "size size 4"], rays: int) -> Kernel:
        """Divide by what would be in the window without absorption."""
        whole, *colours = kernel.sum(axis=(0, 1))[[3, 0, 1, 2]]
        if not min(colours) > 0.0:
            raise InputError(f"none of {rays} photons reached the window: trace more of them, or choose a nearer distance")
        return (kernel[:, :, :3] / whole).astype(np.float32)


def _cut(kernel: np.ndarray) -> np.ndarray:
    """Return the smallest odd window that holds all light."""
    lit = np.nonzero(kernel.any(axis=2))
    middle = len(kernel) // 2
    radius = max(int(np.abs(places - middle).max(initial=0)) for places in lit)
    return kernel[middle - radius : middle + radius + 1, middle - radius : middle + radius + 1]
