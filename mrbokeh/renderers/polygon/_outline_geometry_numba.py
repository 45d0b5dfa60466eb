"""Compiled: whether a closed outline (V, 2) of unit size crosses itself, and how far points lie from it."""

import math

import numpy as np

from mrbokeh.system.kernels import njit

SLACK = 1e-8
"""Lengths up to this are rounding: a point so near a line is on it, one so far beyond a reach still within."""


@njit(cache=True)
def cross(ax: float, ay: float, bx: float, by: float) -> float:
    return ax * by - ay * bx


@njit(cache=True)
def crosses_itself(outline: np.ndarray) -> bool:
    """Whether two edges that are no neighbours cross or overlap by more than rounding."""
    count = outline.shape[0]
    for i in range(count):
        a, b = outline[i], outline[(i + 1) % count]
        for j in range(i + 2, count - (1 if i == 0 else 0)):
            c, d = outline[j], outline[(j + 1) % count]
            c_side, d_side = _side(a, b, c), _side(a, b, d)
            a_side, b_side = _side(c, d, a), _side(c, d, b)
            if c_side * d_side < 0.0 and a_side * b_side < 0.0:
                return True
    return False


@njit(cache=True)
def _side(a: np.ndarray, b: np.ndarray, point: np.ndarray) -> float:
    """Distance of a point to the left of the line from a to b; 0 where it is within rounding of the line."""
    x, y = b[0] - a[0], b[1] - a[1]
    distance = cross(x, y, point[0] - a[0], point[1] - a[1]) / math.hypot(x, y)
    return 0.0 if abs(distance) < SLACK else distance


@njit(cache=True)
def farthest_from_outline(points: np.ndarray, outline: np.ndarray, side: int) -> float:
    """The largest distance of a point from the closed outline, among all points (side 0), those outside (1) or those inside (-1)."""
    farthest, count = 0.0, outline.shape[0]
    for i in range(points.shape[0]):
        x, y = points[i]
        nearest, inside = np.inf, False
        for j in range(count):
            k = j + 1 if j + 1 < count else 0
            ax, ay = outline[j, 0] - x, outline[j, 1] - y
            bx, by = outline[k, 0] - x, outline[k, 1] - y
            share = -(ax * (bx - ax) + ay * (by - ay)) / ((bx - ax) ** 2 + (by - ay) ** 2)
            share = min(max(share, 0.0), 1.0)
            nearest = min(nearest, (ax + share * (bx - ax)) ** 2 + (ay + share * (by - ay)) ** 2)
            if (ay > 0.0) != (by > 0.0) and (ax * by - bx * ay > 0.0) == (by > ay):
                inside = not inside
        if side == 0 or inside == (side < 0):
            farthest = max(farthest, nearest)
    return math.sqrt(farthest)
