"""Where on a shadow catcher a scene's shadow can fall at all. Compiled with numba."""

import numpy as np

from mrbokeh.scene._compiled_numba import compiled
from mrbokeh.scene._vectors_numba import Vector, corner, cross, dot, row, sub


@compiled
def mark_reachable(
    corners_m: np.ndarray,
    hits: np.ndarray,
    eye: np.ndarray,
    directions: np.ndarray,
    own_from_ground: np.ndarray,
    shift: np.ndarray,
    sources: np.ndarray,
    at_infinity: np.ndarray,
    half_size: np.ndarray,
    reached: np.ndarray,
) -> None:
    """Mark rays that meet the ground at a point from which a box hides a light.

    corners_m, eye, directions: of the ground. hits: (N,) its triangle for each ray or -1. The box reaches half_size from the origin
    of its own axes; a ground point is own_from_ground @ point + shift there. sources: (L, 3) in the box's axes, places of lights or,
    where at_infinity, the vectors towards them. reached: (N,) bool, written.
    """
    origin, offset, half = (eye[0], eye[1], eye[2]), (shift[0], shift[1], shift[2]), (half_size[0], half_size[1], half_size[2])
    for i in range(hits.size):
        if hits[i] < 0:
            continue
        a, ray = corner(corners_m, hits[i], 0), row(directions, i)
        normal = cross(sub(corner(corners_m, hits[i], 1), a), sub(corner(corners_m, hits[i], 2), a))
        along = dot(normal, sub(a, origin)) / dot(normal, ray)
        point = (origin[0] + along * ray[0], origin[1] + along * ray[1], origin[2] + along * ray[2])
        own = (
            dot(row(own_from_ground, 0), point) + offset[0],
            dot(row(own_from_ground, 1), point) + offset[1],
            dot(row(own_from_ground, 2), point) + offset[2],
        )
        for k in range(sources.shape[0]):
            source = row(sources, k)
            if _meets_box(own, source if at_infinity[k] else sub(source, own), half, np.inf if at_infinity[k] else 1.0):
                reached[i] = True
                break


@compiled
def _meets_box(start: Vector, towards: Vector, half: Vector, end: float) -> bool:
    """Whether start + t towards, t from 0 to end, meets the box (Kay and Kajiya 1986)."""
    first, last = 0.0, end
    for axis in range(3):
        if towards[axis] == 0.0:
            if abs(start[axis]) > half[axis]:
                return False
            continue
        enter, leave = (-half[axis] - start[axis]) / towards[axis], (half[axis] - start[axis]) / towards[axis]
        first, last = max(first, min(enter, leave)), min(last, max(enter, leave))
    return first <= last
