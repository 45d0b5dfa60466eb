"""Compiled ray casting of a printed sheet on a table; see `charuco_clip`."""

from typing import NamedTuple

import numpy as np

from mrbokeh.system.compiled import njit

TABLE_TILE_M = 0.5


class PackedTable(NamedTuple):
    """A print on a table, metres in z = 0. edges_x, edges_y: sorted ends of all rectangles; black[j, i]: whether the cell between them is.

    sheet: left, top, right, bottom. paper, ink: (3,) radiance. table: (T, T, 3) radiance that repeats every TABLE_TILE_M.
    """

    edges_x: np.ndarray
    edges_y: np.ndarray
    black: np.ndarray
    sheet: np.ndarray
    paper: np.ndarray
    ink: np.ndarray
    table: np.ndarray


class PackedLens(NamedTuple):
    """A camera with a lens. world_from_camera: (4, 4). focal, principal: (2,) px. radius_m: of the pupil. focus_m: along the axis."""

    world_from_camera: np.ndarray
    focal: np.ndarray
    principal: np.ndarray
    radius_m: float
    focus_m: float


@njit(cache=True, error_model="numpy", inline="always")
def _cell(edges: np.ndarray, at: float) -> int:
    """Return the last edge that is not beyond `at`; by halves (numba's searchsorted takes three times as long)."""
    low, high = 0, len(edges)
    while high - low > 1:
        middle = (low + high) // 2
        if edges[middle] <= at:
            low = middle
        else:
            high = middle
    return low


@njit(cache=True, error_model="numpy")
def is_black(table: PackedTable, x: float, y: float) -> bool:
    if not (table.edges_x[0] <= x < table.edges_x[-1] and table.edges_y[0] <= y < table.edges_y[-1]):
        return False
    return table.black[_cell(table.edges_y, y), _cell(table.edges_x, x)]


@njit(cache=True, error_model="numpy", inline="always")
def _fraction(value: float) -> float:
    return value - np.floor(value)


@njit(cache=True, error_model="numpy", inline="always")
def _radiance(table: PackedTable, x: float, y: float) -> tuple[float, float, float]:
    if table.sheet[0] <= x < table.sheet[2] and table.sheet[1] <= y < table.sheet[3]:
        if is_black(table, x, y):
            return table.ink[0], table.ink[1], table.ink[2]
        return table.paper[0], table.paper[1], table.paper[2]
    size = len(table.table)
    across, down = _fraction(x / TABLE_TILE_M) * size, _fraction(y / TABLE_TILE_M) * size
    left, top = int(across), int(down)
    s, t = across - left, down - top
    left, top = left % size, top % size
    right, below = (left + 1) % size, (top + 1) % size
    a, b, c, d = (1.0 - s) * (1.0 - t), s * (1.0 - t), (1.0 - s) * t, s * t
    one, two, three, four = table.table[top, left], table.table[top, right], table.table[below, left], table.table[below, right]
    return (
        a * one[0] + b * two[0] + c * three[0] + d * four[0],
        a * one[1] + b * two[1] + c * three[1] + d * four[1],
        a * one[2] + b * two[2] + c * three[2] + d * four[2],
    )


@njit(cache=True, error_model="numpy", inline="always")
def _point_seen(lens: PackedLens, x_px: float, y_px: float, u: float, v: float) -> tuple[float, float]:
    """Return the point of z = 0 that the ray through a place of the picture and (u, v) metres of the pupil meets; nan if none."""
    pose = lens.world_from_camera
    # From the pupil's point to where the pinhole's ray meets the focus plane, per metre of depth.
    dx = (x_px - lens.principal[0]) / lens.focal[0] - u / lens.focus_m
    dy = (y_px - lens.principal[1]) / lens.focal[1] - v / lens.focus_m
    start = pose[2, 0] * u + pose[2, 1] * v + pose[2, 3]
    depth = -start / (pose[2, 0] * dx + pose[2, 1] * dy + pose[2, 2])
    if not depth > 0.0:
        return np.nan, np.nan
    in_x, in_y = u + dx * depth, v + dy * depth
    x = pose[0, 0] * in_x + pose[0, 1] * in_y + pose[0, 2] * depth + pose[0, 3]
    y = pose[1, 0] * in_x + pose[1, 1] * in_y + pose[1, 2] * depth + pose[1, 3]
    return x, y


@njit(cache=True, error_model="numpy")
def shade(table: PackedTable, lens: PackedLens, samples: np.ndarray, shifts: np.ndarray, rgb: np.ndarray) -> None:
    """Fill rgb (H, W, 3) with means over samples (S, 4), pixel x, y and pupil x, y in [0, 1); shifts (H, W, 4) move them at each pixel."""
    height, width, _ = rgb.shape
    for row in range(height):
        for column in range(width):
            shift = shifts[row, column]
            red, green, blue = 0.0, 0.0, 0.0
            for k in range(len(samples)):
                u, v = 0.0, 0.0
                if lens.radius_m > 0.0:
                    radius = lens.radius_m * np.sqrt(_fraction(samples[k, 2] + shift[2]))
                    angle = 2.0 * np.pi * (samples[k, 3] + shift[3])
                    u, v = radius * np.cos(angle), radius * np.sin(angle)
                x, y = _point_seen(lens, column + _fraction(samples[k, 0] + shift[0]), row + _fraction(samples[k, 1] + shift[1]), u, v)
                if not np.isnan(x):
                    seen = _radiance(table, x, y)
                    red, green, blue = red + seen[0], green + seen[1], blue + seen[2]
            rgb[row, column, 0], rgb[row, column, 1], rgb[row, column, 2] = red / len(samples), green / len(samples), blue / len(samples)
