"""Walking along projected silhouette edges. Compiled with numba."""

from math import ceil

import numpy as np

from mrbokeh.scene._compiled_numba import compiled
from mrbokeh.scene._vectors_numba import Vector


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
