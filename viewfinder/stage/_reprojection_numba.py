"""Loops of late reprojection, compiled; they run without the GIL.

`view` is fx, fy, cx, cy of the camera that drew, then of the new one; rotation and shift take a point from the first to the second.
"""

from typing import NamedTuple

import numpy as np

from mrbokeh.system.compiled import njit


class DepthGrid(NamedTuple):
    """1 / depth of a layer on a grid of cells `cell_px` wide, and where to begin."""

    dioptres: np.ndarray
    cell_px: int
    first_dioptres: float


class Motion(NamedTuple):
    """From the camera that drew to the new one."""

    view: np.ndarray
    rotation: np.ndarray
    shift: np.ndarray


@njit(cache=True, nogil=True, inline="always")
def _source(x, y, dioptres, view, rotation, shift):  # type: ignore[no-untyped-def]
    """Return the place in the layer of what the new camera sees at (x, y), if it has this 1 / depth; far away if behind."""
    ray_x, ray_y = (x - view[6]) / view[4], (y - view[7]) / view[5]
    depth = rotation[0, 2] * ray_x + rotation[1, 2] * ray_y + rotation[2, 2]
    if depth <= 1e-6:
        return -1e9, -1e9
    # ray times `along` is the point at the drawn camera's depth 1: its third coordinate there is 1.
    along = (1.0 + dioptres * (rotation[0, 2] * shift[0] + rotation[1, 2] * shift[1] + rotation[2, 2] * shift[2])) / depth
    p_x, p_y, p_z = along * ray_x - dioptres * shift[0], along * ray_y - dioptres * shift[1], along - dioptres * shift[2]
    u = rotation[0, 0] * p_x + rotation[1, 0] * p_y + rotation[2, 0] * p_z
    v = rotation[0, 1] * p_x + rotation[1, 1] * p_y + rotation[2, 1] * p_z
    return u * view[0] + view[2], v * view[1] + view[3]


@njit(cache=True, nogil=True, inline="always")
def _at(grid, x, y):  # type: ignore[no-untyped-def]
    """Return a grid's value, bilinearly; cells' centres lie at +0.5, and it is continued beyond its border."""
    height, width = grid.shape
    x, y = min(max(x - 0.5, 0.0), width - 1.0), min(max(y - 0.5, 0.0), height - 1.0)
    i, j = min(int(x), max(width - 2, 0)), min(int(y), max(height - 2, 0))
    i1, j1 = min(i + 1, width - 1), min(j + 1, height - 1)
    a, b = x - i, y - j
    return (1 - b) * ((1 - a) * grid[j, i] + a * grid[j, i1]) + b * ((1 - a) * grid[j1, i] + a * grid[j1, i1])


@njit(cache=True, nogil=True)
def source_nodes(nodes, left, top, step, depth, rounds, motion) -> None:  # type: ignore[no-untyped-def]
    """Fill nodes (N, M, 2): the place in the layer of pixel (left + step j, top + step i), by fixed-point iteration over 1 / depth."""
    dioptres, cell, first_dioptres = depth
    view, rotation, shift = motion
    for i in range(nodes.shape[0]):
        for j in range(nodes.shape[1]):
            x, y = left + step * j + 0.5, top + step * i + 0.5
            u, v = _source(x, y, first_dioptres, view, rotation, shift)
            for _ in range(rounds):
                u, v = _source(x, y, _at(dioptres, u / cell, v / cell), view, rotation, shift)
            nodes[i, j, 0], nodes[i, j, 1] = u, v


@njit(cache=True, nogil=True)
def sample(rgb, shines_through, rgba, nodes, step, opacity) -> None:  # type: ignore[no-untyped-def]
    """Sample the layer between the nodes, bilinearly; nothing beyond its border. Writes rgb (H, W, 3) and shines_through (H, W)."""
    height, width = shines_through.shape
    rows, columns = rgba.shape[0], rgba.shape[1]
    for i in range(height):
        ni, b = i // step, (i % step) / step
        for nj in range(nodes.shape[1] - 1):
            u = (1 - b) * nodes[ni, nj, 0] + b * nodes[ni + 1, nj, 0] - 0.5
            v = (1 - b) * nodes[ni, nj, 1] + b * nodes[ni + 1, nj, 1] - 0.5
            du = ((1 - b) * nodes[ni, nj + 1, 0] + b * nodes[ni + 1, nj + 1, 0] - 0.5 - u) / step
            dv = ((1 - b) * nodes[ni, nj + 1, 1] + b * nodes[ni + 1, nj + 1, 1] - 0.5 - v) / step
            for j in range(nj * step, min((nj + 1) * step, width)):
                red = green = blue = alpha = np.float32(0.0)
                if 0.0 <= u < columns - 1 and 0.0 <= v < rows - 1:
                    left, top = np.uint64(u), np.uint64(v)
                    x, y = np.float32(u - left), np.float32(v - top)
                    right, below = left + np.uint64(1), top + np.uint64(1)
                    w11 = x * y
                    w01, w10 = x - w11, y - w11
                    w00 = np.float32(1.0) - x - w10
                    red = w00 * rgba[top, left, 0] + w01 * rgba[top, right, 0] + w10 * rgba[below, left, 0] + w11 * rgba[below, right, 0]
                    green = w00 * rgba[top, left, 1] + w01 * rgba[top, right, 1] + w10 * rgba[below, left, 1] + w11 * rgba[below, right, 1]
                    blue = w00 * rgba[top, left, 2] + w01 * rgba[top, right, 2] + w10 * rgba[below, left, 2] + w11 * rgba[below, right, 2]
                    alpha = w00 * rgba[top, left, 3] + w01 * rgba[top, right, 3] + w10 * rgba[below, left, 3] + w11 * rgba[below, right, 3]
                elif -1.0 < u < columns and -1.0 < v < rows:
                    red, green, blue, alpha = _at_border(rgba, u, v)
                rgb[i, j, 0], rgb[i, j, 1], rgb[i, j, 2] = opacity * red, opacity * green, opacity * blue
                shines_through[i, j] = np.float32(1.0) - opacity * alpha
                u, v = u + du, v + dv


@njit(cache=True, nogil=True)
def _at_border(rgba, u, v):  # type: ignore[no-untyped-def]
    """Sample where some of the four neighbours do not exist."""
    left, top = int(np.floor(u)), int(np.floor(v))
    red = green = blue = alpha = np.float32(0.0)
    for y in range(max(top, 0), min(top + 2, rgba.shape[0])):
        for x in range(max(left, 0), min(left + 2, rgba.shape[1])):
            weight = np.float32((1.0 - abs(u - x)) * (1.0 - abs(v - y)))
            red += weight * rgba[y, x, 0]
            green += weight * rgba[y, x, 1]
            blue += weight * rgba[y, x, 2]
            alpha += weight * rgba[y, x, 3]
    return red, green, blue, alpha
