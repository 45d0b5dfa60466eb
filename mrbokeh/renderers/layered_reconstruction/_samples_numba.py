"""Samples in the order in which they are worked through: tile by tile, within a tile by pixels in Morton order."""

import numpy as np

from mrbokeh.renderers.layered_reconstruction._tile_data import BLOCKS
from mrbokeh.system.kernels import njit


@njit(cache=True, nogil=True)
def morton(x: int, y: int) -> int:
    """The bits of x and y interleaved, x first: neighbours in the plane stay neighbours on the line."""
    code = 0
    for bit in range(8):
        code |= ((x >> bit) & 1) << (2 * bit)
        code |= ((y >> bit) & 1) << (2 * bit + 1)
    return code


@njit(cache=True, nogil=True)
def tile_order(xy_px: np.ndarray, width_px: int, height_px: int, tile_px: int, order: np.ndarray, starts: np.ndarray) -> None:
    """Fill order (N,) with the indices of the samples and starts (tiles + 1,) with where each tile begins; stable.

    tile_px: a power of two, at most 256.
    """
    columns, rows = -(-width_px // tile_px), -(-height_px // tile_px)
    per_tile = tile_px * tile_px
    ends = np.zeros(columns * rows * per_tile + 1, np.int64)
    keys = np.empty(len(xy_px), np.int64)
    for i in range(len(xy_px)):
        x, y = min(int(xy_px[i, 0]), width_px - 1), min(int(xy_px[i, 1]), height_px - 1)
        tile = (y // tile_px) * columns + x // tile_px
        keys[i] = tile * per_tile + morton(x % tile_px, y % tile_px)
        ends[keys[i] + 1] += 1
    for key in range(len(ends) - 1):
        ends[key + 1] += ends[key]
    for block in range(len(starts)):
        starts[block] = ends[block * (per_tile // BLOCKS)]
    for i in range(len(keys)):
        order[ends[keys[i]]] = i
        ends[keys[i]] += 1


@njit(cache=True, nogil=True)
def gather(
    order: np.ndarray, xy_px: np.ndarray, lens_uv: np.ndarray, time: np.ndarray, coc_px: np.ndarray, motion_px: np.ndarray,
    values: np.ndarray, bucket: np.ndarray, moves: bool,
    geometry: np.ndarray, slopes: np.ndarray, sorted_values: np.ndarray, sorted_bucket: np.ndarray,
) -> None:  # fmt: skip
    """Fill geometry (N, 5), slopes (N, 3), values and buckets in this order; without motion where moves is False."""
    for k in range(len(order)):
        i = order[k]
        geometry[k, 0], geometry[k, 1] = xy_px[i, 0], xy_px[i, 1]
        geometry[k, 2], geometry[k, 3] = lens_uv[i, 0], lens_uv[i, 1]
        geometry[k, 4] = time[i] - np.float32(0.5)
        slopes[k, 0] = np.float32(0.5) * coc_px[i]
        slopes[k, 1] = motion_px[i, 0] if moves else np.float32(0.0)
        slopes[k, 2] = motion_px[i, 1] if moves else np.float32(0.0)
        for c in range(values.shape[1]):
            sorted_values[k, c] = values[i, c]
        sorted_bucket[k] = bucket[i]
