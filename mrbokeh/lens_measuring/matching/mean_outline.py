"""The mean outline of discs that look like none of the openings with blades: a drawn, cut-out or dirty one."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64

from mrbokeh.lens_measuring.matching.discs import Disc
from mrbokeh.optics.aperture import Aperture

ANGLES = 96
FEWEST_DISCS = 3
_ALIKE, _ALIKE_PX = 0.05, 0.2
_LEAST_SHARE = 0.4


@dataclass(frozen=True)
class MeanOutline:
    """aperture: in the unit pupil. radius_px: of that unit in each disc. disagreement: of the discs with the mean, share of the radius."""

    discs: tuple[Disc, ...]
    aperture: Aperture
    radius_px: Float64[np.ndarray, " discs"]
    disagreement: float


def mean_outline(discs: Sequence[Disc], side: int) -> MeanOutline | None:
    """The mean of the largest group of discs that look alike; None where too few or too small a share of them do."""
    shapes = np.stack([_radius_over_angle(disc, side) for disc in discs])
    sizes = np.array([disc.radius_px for disc in discs])
    limit = np.maximum(_ALIKE, _ALIKE_PX / sizes)
    apart = np.sqrt(((shapes[:, None] - shapes[None]) ** 2).mean(axis=2))
    middle = int((apart < 2.0 * limit).sum(axis=1).argmax())
    mean = np.median(shapes[apart[middle] < 2.0 * limit], axis=0)
    away = np.sqrt(((shapes - mean) ** 2).mean(axis=1))
    alike = away < limit
    if alike.sum() < max(FEWEST_DISCS, _LEAST_SHARE * len(discs)):
        return None
    mean = np.average(shapes[alike], axis=0, weights=sizes[alike] ** 2)
    angles = 2.0 * np.pi * np.arange(ANGLES) / ANGLES
    points = mean[:, None] * np.stack([np.cos(angles), np.sin(angles)], axis=1)
    kept = tuple(disc for disc, is_alike in zip(discs, alike, strict=True) if is_alike)
    return MeanOutline(kept, Aperture.from_outline(points), sizes[alike] * float(mean.max()), float(np.median(away[alike])))


def _radius_over_angle(disc: Disc, side: int) -> Float64[np.ndarray, " angles"]:
    """About the centroid, in radii of the disc of the same area; the farthest crossing where a direction has several."""
    away = side * (disc.contour_px - disc.centroid_px) / disc.radius_px
    angles, radius = np.arctan2(away[:, 1], away[:, 0]), np.hypot(away[:, 0], away[:, 1])
    order = np.argsort(angles)
    return np.interp(2.0 * np.pi * np.arange(ANGLES) / ANGLES, angles[order], radius[order], period=2.0 * np.pi)
