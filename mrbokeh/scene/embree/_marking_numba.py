"""Kernels that mark rays and pixels: rays to a catcher in reach of a shadow, pixels at edges, pixels under silhouettes. Compiled with
numba.
"""

from math import ceil

import numpy as np

from mrbokeh.scene._vectors_numba import Vector, compiled, corner, cross, dot, row, sub


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
    """Return whether start + t towards, t from 0 to end, meets the box (Kay and Kajiya 1986)."""
    first, last = 0.0, end
    for axis in range(3):
        if towards[axis] == 0.0:
            if abs(start[axis]) > half[axis]:
                return False
            continue
        enter, leave = (-half[axis] - start[axis]) / towards[axis], (half[axis] - start[axis]) / towards[axis]
        first, last = max(first, min(enter, leave)), min(last, max(enter, leave))
    return first <= last


@compiled
def mark_edges(
    mesh: np.ndarray,
    alpha: np.ndarray,
    depth_m: np.ndarray,
    normal: np.ndarray,
    lit: np.ndarray,
    directions: np.ndarray,
    width: int,
    steps: np.ndarray,
    edges: np.ndarray,
) -> None:
    """See `edge_pixels`. All arrays are flat, row after row. steps: of shares, relative of depth, cosine. edges: bool, written."""
    share_step, depth_step, least_cosine = steps[0], steps[1], steps[2]
    count = mesh.size
    for here in range(count):
        column = here % width
        for side in range(4):
            right = 1 if side == 0 else side - 2
            there = here + (0 if side == 0 else width) + right
            if there >= count or column + right < 0 or column + right >= width:
                continue
            differs = mesh[here] != mesh[there] or abs(alpha[here] - alpha[there]) > share_step or abs(lit[here] - lit[there]) > share_step
            if not differs and mesh[here] >= 0 and (side == 0 or right == 0):
                # The neighbour's ray meets this pixel's tangent plane at the depth that is expected of it.
                own = row(normal, here)
                expected_m = depth_m[here] * dot(own, row(directions, here)) / dot(own, row(directions, there))
                near_enough = abs(depth_m[there] - expected_m) < depth_step * min(depth_m[here], depth_m[there])
                differs = not (near_enough and dot(own, row(normal, there)) > least_cosine)
            if differs:
                edges[here] = True
                edges[there] = True


@compiled
def mark_segments(ends: np.ndarray, intrinsics: np.ndarray, farthest: np.ndarray, marked: np.ndarray) -> None:
    """Mark the pixels under segments given in camera axes (metres), where they lie before `farthest`.

    ends: (S, 2, 3). intrinsics: fx, fy, cx, cy. farthest: (H, W) metres. marked: (H, W) bool, written.
    """
    fx, fy, cx, cy = intrinsics[0], intrinsics[1], intrinsics[2], intrinsics[3]
    height, width = marked.shape
    for s in range(ends.shape[0]):
        z0, z1 = ends[s, 0, 2], ends[s, 1, 2]
        if z0 <= 1e-6 and z1 <= 1e-6:
            continue
        # Cut off what lies behind the eye.
        t0, t1 = 0.0, 1.0
        if z0 <= 1e-6:
            t0 = (1e-6 - z0) / (z1 - z0)
        if z1 <= 1e-6:
            t1 = (1e-6 - z0) / (z1 - z0)
        ax, ay, az = _point(ends, s, t0)
        bx, by, bz = _point(ends, s, t1)
        x0, y0, x1, y1 = fx * ax / az + cx, fy * ay / az + cy, fx * bx / bz + cx, fy * by / bz + cy
        first, last = _inside(x0, y0, x1, y1, width, height)
        if first >= last:
            continue
        # Two points per pixel; the inverse depth is linear along the projected segment.
        steps = ceil(2.0 * (last - first) * max(abs(x1 - x0), abs(y1 - y0))) + 1
        for k in range(steps + 1):
            t = first + (last - first) * k / steps
            column, row = int(x0 + t * (x1 - x0)), int(y0 + t * (y1 - y0))
            if 0 <= column < width and 0 <= row < height:
                depth = 1.0 / (1.0 / az + t * (1.0 / bz - 1.0 / az))
                if depth <= farthest[row, column] * 1.001:
                    marked[row, column] = True


@compiled
def _point(ends: np.ndarray, s: int, t: float) -> Vector:
    return (
        ends[s, 0, 0] + t * (ends[s, 1, 0] - ends[s, 0, 0]),
        ends[s, 0, 1] + t * (ends[s, 1, 1] - ends[s, 0, 1]),
        ends[s, 0, 2] + t * (ends[s, 1, 2] - ends[s, 0, 2]),
    )


@compiled
def _inside(x0: float, y0: float, x1: float, y1: float, width: int, height: int) -> tuple[float, float]:
    """The part [first, last] of a segment within the picture (Liang and Barsky 1984)."""
    first, last = 0.0, 1.0
    for start, change, limit in ((x0, x1 - x0, float(width)), (y0, y1 - y0, float(height))):
        if change == 0.0:
            if start < 0.0 or start > limit:
                return 1.0, 0.0
            continue
        enter, leave = -start / change, (limit - start) / change
        if enter > leave:
            enter, leave = leave, enter
        first, last = max(first, enter), min(last, leave)
    return first, last
