"""Which of many views to compare with a reference: those that see most of the same and stand apart enough to tell depth."""

from collections.abc import Sequence

import numpy as np

from capture.views.distortion import distorted_px
from capture.views.plane_sweep_planes import pixels_per_dioptre
from capture.views.plane_sweep_view import SweepView

LEAST_PARALLAX_PX = 8.0
LEAST_SHARE = 0.25
_GRID = 12


def shared_part(reference: SweepView, other: SweepView, dioptres: Sequence[float]) -> float:
    """How much of the reference the other view has in its frame, on average over planes at these dioptres (above 0)."""
    camera = reference.camera
    x, y = np.meshgrid((np.arange(_GRID) + 0.5) / _GRID * camera.width_px, (np.arange(_GRID) + 0.5) / _GRID * camera.height_px)
    xy_px = np.stack([x, y], axis=-1)
    shares = []
    for dioptre in dioptres:
        points_m = camera.unproject(xy_px, np.full(x.shape, 1.0 / dioptre))
        there, depth_m = other.camera.project(points_m)
        column, row = np.moveaxis(distorted_px(other.camera, other.distortion, there), -1, 0)
        inside = (column >= 0) & (row >= 0) & (column < other.camera.width_px) & (row < other.camera.height_px)
        shares.append(np.mean(inside & (depth_m > 0)))
    return float(np.mean(shares))


def choose_neighbours(reference: SweepView, others: Sequence[SweepView], dioptre_range: tuple[float, float], most: int = 6) -> list[int]:
    """Indices of at most so many others: of those that share most, the one that stands nearest first.

    Those that show too little parallax or share too little are left out.
    """
    farthest, nearest = dioptre_range
    dioptres = np.linspace(max(farthest, 0.02 * nearest), nearest, 3).tolist()
    shares, travels_px = {}, {}
    for index, other in enumerate(others):
        travel_px = pixels_per_dioptre(reference, other, nearest, farthest) * (nearest - farthest)
        share = shared_part(reference, other, dioptres)
        if travel_px >= LEAST_PARALLAX_PX and share >= LEAST_SHARE:
            shares[index], travels_px[index] = share, travel_px
    chosen = sorted(shares, key=lambda index: -shares[index])[:most]
    return sorted(chosen, key=lambda index: travels_px[index])
