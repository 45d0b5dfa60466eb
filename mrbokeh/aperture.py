"""Aperture: the opening of a lens as a weighted sum of polygons, and the PSF that it casts."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64

from mrbokeh.errors import InputError
from mrbokeh.psf import Psf, kernel_radius_px


@dataclass(frozen=True, eq=False)
class Aperture:
    """Weighted polygons in the unit pupil, seen from behind the camera: x right, y down.

    outlines: each (V, 2), within about 1 of the origin, not crossing itself.
    weights: one number per outline; a ring is +1 for the outer and -1 for the inner outline.
    A point behind the focus plane shows the outlines as they are, a point in front shows them mirrored through
    the origin: follow the ray through lens point u, it is displaced by u times half the signed circle of confusion.
    """

    outlines: tuple[Float64[np.ndarray, "_ 2"], ...]
    weights: tuple[float, ...]

    def __post_init__(self) -> None:
        if len(self.outlines) != len(self.weights) or not self.outlines:
            raise InputError(f"an aperture needs one weight per outline, but came with {len(self.outlines)} and {len(self.weights)}")
        if any(outline.ndim != 2 or outline.shape[0] < 3 or outline.shape[1] != 2 for outline in self.outlines):
            raise InputError("every outline of an aperture must be (V, 2) with at least 3 vertices")

    @classmethod
    def disc(cls, sides: int = 64) -> "Aperture":
        """A round opening: a regular polygon with the area of the unit disc, so that it passes the same light."""
        radius = np.sqrt(2.0 * np.pi / (sides * np.sin(2.0 * np.pi / sides)))
        return cls((_regular_polygon(sides, 0.0) * radius,), (1.0,))

    @classmethod
    def blades(cls, count: int, rotation_rad: float = 0.0) -> "Aperture":
        """A straight-bladed iris: a regular polygon with its corners on the unit circle."""
        if count < 3:
            raise InputError(f"an iris needs at least 3 blades, got {count}")
        return cls((_regular_polygon(count, rotation_rad),), (1.0,))

    def obstructed(self, share: float) -> "Aperture":
        """With a round stop in the middle, as the mirror of a catadioptric lens leaves it: points blur to rings.

        share: diameter of the stop over that of the unit pupil, 0 to below 1 (and within the outline).
        """
        if not 0.0 <= share < 1.0:
            raise InputError(f"a central obstruction is a share of the diameter from 0 to below 1, got {share}")
        return self if share == 0.0 else Aperture((*self.outlines, share * Aperture.disc().outlines[0]), (*self.weights, -1.0))

    @property
    def unit_radius(self) -> float:
        """Distance of the farthest vertex from the centre of the pupil."""
        return max(float(np.hypot(*outline.T).max()) for outline in self.outlines)

    def packed(self) -> tuple[Float64[np.ndarray, "vertices 2"], np.ndarray, Float64[np.ndarray, " outlines"]]:
        """(vertices of all outlines, where each starts, weights), the form that compiled code takes."""
        starts = np.cumsum([0, *(len(outline) for outline in self.outlines)])
        return np.concatenate(self.outlines), starts, np.asarray(self.weights, np.float64)

    def rasterize(self, diameter_px: float) -> Psf:
        """The PSF at a signed diameter with exact area coverage, sum 1; below one pixel it is the identity."""
        from mrbokeh._polygon_coverage_numba import fill_psf

        size = 2 * kernel_radius_px(diameter_px, self.unit_radius) + 1
        kernel, steps = np.zeros((size, size)), np.zeros((size, size))
        fill_psf(kernel, steps, *self.packed(), float(diameter_px))
        return Psf(kernel)


def _regular_polygon(sides: int, rotation_rad: float) -> Float64[np.ndarray, "sides 2"]:
    angles_rad = rotation_rad + 2.0 * np.pi * np.arange(sides) / sides
    return np.stack([np.cos(angles_rad), np.sin(angles_rad)], axis=1)
