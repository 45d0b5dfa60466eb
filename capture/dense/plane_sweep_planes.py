"""Planes of a sweep, equally spaced in dioptres: steps that move the picture of the widest neighbour by so many pixels."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from capture.poses.sweep_view import SweepView, neighbour_from_reference
from mrbokeh.system.errors import InputError

LEAST_PARALLAX_PX = 8.0
_PROBES = 5


def pixels_per_dioptre(reference: SweepView, neighbour: SweepView, nearest_dioptre: float, farthest_dioptre: float) -> float:
    """The fastest that a point moves in the neighbour's picture with its dioptre (0 for a neighbour at the same place)."""
    camera = reference.camera
    x, y = np.meshgrid(np.linspace(0.0, camera.width_px, _PROBES), np.linspace(0.0, camera.height_px, _PROBES))
    plane = (np.stack([x, y], axis=-1) - camera.principal_px) / np.asarray(camera.focal_px)
    rays = np.concatenate([plane, np.ones_like(plane[..., :1])], axis=-1)
    pose = neighbour_from_reference(camera, neighbour.camera)
    rotated = rays @ pose[:3, :3].T
    fastest = 0.0
    for dioptre in np.linspace(farthest_dioptre, nearest_dioptre, _PROBES):
        x_y_z = rotated + dioptre * pose[:3, 3]
        before = x_y_z[..., 2] > 1e-3
        if before.any():
            moves = (pose[:2, 3] * x_y_z[..., 2:] - x_y_z[..., :2] * pose[2, 3]) / x_y_z[..., 2:] ** 2
            fastest = max(fastest, float(np.linalg.norm(moves * neighbour.camera.focal_px, axis=-1)[before].max()))
    return fastest


def dioptre_planes(
    reference: SweepView, neighbours: Sequence[SweepView], dioptre_range: tuple[float, float], step_px: float = 0.5, most: int = 0
) -> Float[np.ndarray, " planes"]:
    """Dioptres from far to near (ascending) in steps of at most `step_px` in the widest neighbour; `most` > 0 caps their number.

    dioptre_range: (farthest, nearest), 1 / metres. Raises InputError where no neighbour stands apart from the reference.
    """
    farthest, nearest = dioptre_range
    if not 0.0 <= farthest < nearest:
        raise InputError(f"a plane sweep needs a range of depths from far to near, got {farthest:g} to {nearest:g} dioptres")
    rates = [pixels_per_dioptre(reference, each, nearest, farthest) for each in neighbours]
    travel_px = max(rates, default=0.0) * (nearest - farthest)
    if travel_px < 1.0:
        raise InputError(
            f"no neighbouring view shows parallax (the largest shift is {travel_px:.2f} px over the range of depths): "
            f"photograph from places that lie apart, or keep the depth from focus"
        )
    count = int(np.ceil(travel_px / step_px)) + 1
    return np.linspace(farthest, nearest, min(count, most) if most else count)


def by_parallax(reference: SweepView, neighbours: Sequence[SweepView], dioptre_range: tuple[float, float]) -> list[SweepView]:
    """The neighbours, least parallax first, for in those planes lie densest; but last those that show too little to tell depth."""
    farthest, nearest = dioptre_range

    def place(neighbour: SweepView) -> tuple[bool, float]:
        travel_px = pixels_per_dioptre(reference, neighbour, nearest, farthest) * (nearest - farthest)
        return travel_px < LEAST_PARALLAX_PX, travel_px

    return sorted(neighbours, key=place)
