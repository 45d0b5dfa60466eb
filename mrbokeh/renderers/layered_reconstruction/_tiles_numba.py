"""Compiled reconstruction of one tile after the other: its partitions, front to back, filtered and laid behind one another, in parts.

Parts of pupil and shutter cost as much as the whole does, for each of them anew, and make a difference only where layers hide one
another and the place in the pupil, or the time, decides what. A picture of a quarter of the resolution shows where, for next to nothing;
elsewhere parts are merged.
"""

import numpy as np

from mrbokeh.renderers.layered_reconstruction._gaussians_numba import WINDOWS, gaussian_layer
from mrbokeh.renderers.layered_reconstruction._partitions_numba import partitions_of_tile
from mrbokeh.renderers.layered_reconstruction._tile_data import BLOCKS, Choice, Light, Partitions, Pupil, WindowLayer
from mrbokeh.renderers.layered_reconstruction._windows_numba import composite, lay_parts, own_means, share_out, window_guards, window_layer
from mrbokeh.system.compiled import njit

COARSE_PX = 4
"""Side of the pixels on which the whole and its parts are compared."""
DARK = 0.1
"""Differences count relative to a pixel's own value and to this share of the tile's mean."""
MOST_RATIO = 2.0
"""A coarse pixel of parts that has more times the light of the whole is told from it by more than a factor."""
ONCE = np.int64(1)
"""A number of times that is no literal: numba compiles anew for literals, and for the memory layouts that [:, :, :] makes one of."""


@njit(cache=True, nogil=True)
def reconstruct_tiles(
    out: np.ndarray, tiles: np.ndarray, counts: np.ndarray, light: Light, choice: Choice, whole: Pupil, cells: Pupil, buckets: int
) -> None:
    """Fill the pixels of these tiles of out (H, W, C), and counts (T, 2) of populated buckets and partitions.

    whole: the pupil, for tiles of one partition, which hides nothing. cells: the same in parts.
    """
    place = np.full(buckets, -1, np.int32)
    tile_px = light.tile_px
    for tile in tiles:
        partitions, touched, populated = partitions_of_tile(tile, light, choice, place)
        counts[tile, 0], counts[tile, 1] = populated, len(partitions.sums)
        left, top = (tile % light.columns) * tile_px, (tile // light.columns) * tile_px
        picture = out[top : top + tile_px, left : left + tile_px]
        if choice.kind != WINDOWS:
            seen_past = by_gaussians(picture, left, top, partitions, light, choice)
        elif len(partitions.sums) == 1:
            seen_past = in_parts(picture, left, top, partitions, light, choice, whole, ONCE)
        elif choice.part_tolerance > 0.0 and len(cells.shares) * choice.times > 1:
            seen_past = in_merged_parts(picture, left, top, partitions, light, choice, whole, cells)
        else:
            seen_past = in_parts(picture, left, top, partitions, light, choice, cells, choice.times)
        first, end = light.starts[tile * BLOCKS], light.starts[(tile + 1) * BLOCKS]
        own_means(picture, seen_past, left, top, first, end, light.geometry, light.values)
        for bucket in touched:
            place[bucket] = -1


@njit(cache=True, nogil=True)
def by_gaussians(picture: np.ndarray, left: int, top: int, partitions: Partitions, light: Light, choice: Choice) -> np.ndarray:
    height, width, channels = picture.shape
    seen_past = np.ones((height, width), np.float32)
    layer = np.empty((height, width, channels + 2), np.float32)
    picture[:] = 0.0
    for j in range(len(partitions.sums)):
        gaussian_layer(layer, left, top, j, partitions, light, choice)
        composite(picture, seen_past, layer)
    share_out(picture, seen_past)
    return seen_past


@njit(cache=True, nogil=True)
def in_parts(
    picture: np.ndarray, left: int, top: int, partitions: Partitions, light: Light, choice: Choice, pupil: Pupil, times: int
) -> np.ndarray:
    """Fill a tile with its partitions through every part; returns what none of them claims of each pixel (h, w)."""
    pictures = np.zeros((len(pupil.shares), times, *picture.shape), np.float32)
    parts_past = np.ones(pictures.shape[:4], np.float32)
    for j in range(len(partitions.sums)):
        lay_parts(pictures, parts_past, window_layer(left, top, picture.shape, j, partitions, light, choice), pupil)
    seen_past = mean_of_parts(picture, pictures, parts_past, pupil.shares)
    share_out(picture, seen_past)
    return seen_past


@njit(cache=True, nogil=True)
def in_merged_parts(
    picture: np.ndarray, left: int, top: int, partitions: Partitions, light: Light, choice: Choice, whole: Pupil, cells: Pupil
) -> np.ndarray:
    """Fill a tile as in_parts does, but in parts only for the pixels that need them; the others take the whole times, coarsely, parts
    over the whole.
    """
    height, width, _ = picture.shape
    layers = [window_layer(left, top, picture.shape, j, partitions, light, choice) for j in range(len(partitions.sums))]
    ratio, found = coarse_ratio(layers, picture.shape, whole, cells, choice.times, choice.part_tolerance)
    box = box_of(found, height, width)
    seen_past = np.empty((height, width), np.float32)
    if (box[1] - box[0]) * (box[3] - box[2]) < height * width:
        seen_past[:] = laid(picture, layers, whole, ONCE)
        scale_by_coarse(picture, ratio)
    if box[1] > 0:
        inside = picture[box[0] : box[1], box[2] : box[3]]
        seen_past[box[0] : box[1], box[2] : box[3]] = laid(inside, [cropped(one, box) for one in layers], cells, choice.times)
    return seen_past


@njit(cache=True, nogil=True)
def coarse(one: WindowLayer, height: int, width: int) -> WindowLayer:
    """Return the same layer of a tile of height x width in pixels COARSE_PX as large, each the mean of those it is made of."""
    scale, length_x, length_y = one.scale / COARSE_PX, one.length_x / COARSE_PX, one.length_y / COARSE_PX
    guard_x, guard_y, guard, _ = window_guards(scale, 1.0, length_x, length_y, 0.0)
    beyond_x, beyond_y = guard_x + guard, guard_y + guard
    fine_x, fine_y = one.guard_x + one.guard, one.guard_y + one.guard
    rows, columns = -(-height // COARSE_PX) + 2 * beyond_y, -(-width // COARSE_PX) + 2 * beyond_x
    planes = np.zeros((rows, columns, one.planes.shape[2]), np.float32)
    share = np.float32(1.0 / COARSE_PX**2)
    for y in range(one.planes.shape[0]):
        row = (y - fine_y) // COARSE_PX + beyond_y
        if 0 <= row < rows:
            for x in range(one.planes.shape[1]):
                column = (x - fine_x) // COARSE_PX + beyond_x
                if 0 <= column < columns:
                    for c in range(planes.shape[2]):
                        planes[row, column, c] += share * one.planes[y, x, c]
    return WindowLayer(planes, scale, length_x, length_y, guard_x, guard_y, guard)


@njit(cache=True, nogil=True)
def laid(picture: np.ndarray, layers: list[WindowLayer], pupil: Pupil, times: int) -> np.ndarray:
    """Fill picture (h, w, C) with layers, front to back, the mean over parts; returns what is left of each pixel (h, w)."""
    height, width, channels = picture.shape
    pictures = np.zeros((len(pupil.shares), times, height, width, channels), np.float32)
    parts_past = np.ones(pictures.shape[:4], np.float32)
    for one in layers:
        lay_parts(pictures, parts_past, one, pupil)
    seen_past = mean_of_parts(picture, pictures, parts_past, pupil.shares)
    share_out(picture, seen_past)
    return seen_past


@njit(cache=True, nogil=True)
def mean_of_parts(picture: np.ndarray, pictures: np.ndarray, parts_past: np.ndarray, shares: np.ndarray) -> np.ndarray:
    """Fill picture (h, w, C) with the mean over cells, by their shares, and times; returns that of what is left (h, w)."""
    seen_past = np.zeros(parts_past.shape[2:], np.float32)
    picture[:] = 0.0
    for cell in range(pictures.shape[0]):
        share = np.float32(shares[cell] / pictures.shape[1])
        for time in range(pictures.shape[1]):
            picture += share * pictures[cell, time]
            seen_past += share * parts_past[cell, time]
    return seen_past


@njit(cache=True, nogil=True)
def coarse_ratio(
    layers: list[WindowLayer], shape: tuple, whole: Pupil, cells: Pupil, times: int, tolerance: float
) -> tuple[np.ndarray, np.ndarray]:
    """Return parts over the whole, (h, w, C) in coarse pixels, and where such pixels cannot hold what parts add, (h, w) of bool.

    shape: height, width and channels of the tile.
    """
    small = (-(-shape[0] // COARSE_PX), -(-shape[1] // COARSE_PX), shape[2])
    alike, apart = np.empty(small, np.float32), np.empty(small, np.float32)
    coarser = [coarse(one, shape[0], shape[1]) for one in layers]
    laid(alike[:, :, :], coarser, whole, ONCE)
    laid(apart[:, :, :], coarser, cells, times)
    ratio = ratio_of(alike, apart)
    return ratio, too_detailed(alike, apart, ratio, tolerance)


@njit(cache=True, nogil=True)
def ratio_of(alike: np.ndarray, apart: np.ndarray) -> np.ndarray:
    """Return parts over the whole, from 0 to MOST_RATIO, 1 where the whole is 0. A factor leaves dark pixels alone, and what channels
    have in common.
    """
    ratio = np.ones_like(alike)
    for y in range(ratio.shape[0]):
        for x in range(ratio.shape[1]):
            for c in range(ratio.shape[2]):
                if alike[y, x, c] != 0.0:
                    ratio[y, x, c] = min(max(apart[y, x, c] / alike[y, x, c], 0.0), MOST_RATIO)
    return ratio


@njit(cache=True, nogil=True)
def too_detailed(alike: np.ndarray, apart: np.ndarray, ratio: np.ndarray, tolerance: float) -> np.ndarray:
    """Return where the light that parts add has detail (differs from the mean of its 3 x 3 pixels), or is no such factor."""
    height, width, channels = alike.shape
    found = np.zeros((height, width), np.bool_)
    for c in range(channels):
        dark = DARK * np.abs(apart[..., c]).mean()
        added = apart[..., c] - alike[..., c]
        for y in range(height):
            for x in range(width):
                mean = added[max(0, y - 1) : y + 2, max(0, x - 1) : x + 2].mean()
                value = max(abs(alike[y, x, c]), abs(apart[y, x, c]))
                missed = abs(apart[y, x, c] - ratio[y, x, c] * alike[y, x, c])
                found[y, x] |= max(abs(added[y, x] - mean), missed) > tolerance * (value + dark)
    return found


@njit(cache=True, nogil=True)
def box_of(found: np.ndarray, height: int, width: int) -> tuple[int, int, int, int]:
    """Return top, bottom, left and right of the pixels of a tile that hold all that was found; all 0 where nothing was."""
    top, bottom, left, right = height, 0, width, 0
    for y in range(found.shape[0]):
        for x in range(found.shape[1]):
            if found[y, x]:
                top, bottom = min(top, y * COARSE_PX), max(bottom, min((y + 1) * COARSE_PX, height))
                left, right = min(left, x * COARSE_PX), max(right, min((x + 1) * COARSE_PX, width))
    return (top, bottom, left, right) if bottom > 0 else (0, 0, 0, 0)


@njit(cache=True, nogil=True)
def scale_by_coarse(picture: np.ndarray, ratio: np.ndarray) -> None:
    """Multiply a picture by coarse pixels (h, w, C), linear between their middles."""
    height, width, channels = picture.shape
    for y in range(height):
        row, below = between(y, ratio.shape[0])
        next_row = min(row + 1, ratio.shape[0] - 1)
        for x in range(width):
            column, right = between(x, ratio.shape[1])
            next_column = min(column + 1, ratio.shape[1] - 1)
            for c in range(channels):
                first = ratio[row, column, c] + right * (ratio[row, next_column, c] - ratio[row, column, c])
                second = ratio[next_row, column, c] + right * (ratio[next_row, next_column, c] - ratio[next_row, column, c])
                picture[y, x, c] *= first + below * (second - first)


@njit(cache=True, nogil=True)
def between(at: int, count: int) -> tuple[int, np.float32]:
    """Return the coarse pixel before the middle of a fine one and the share of the next; at the border the first or the last alone."""
    place = min(max((at + 0.5) / COARSE_PX - 0.5, 0.0), count - 1.0)
    return int(place), np.float32(place - int(place))


@njit(cache=True, nogil=True)
def cropped(one: WindowLayer, box: tuple[int, int, int, int]) -> WindowLayer:
    """Return the part of a layer that the pixels from top to bottom and from left to right need."""
    beyond_x, beyond_y = 2 * (one.guard_x + one.guard), 2 * (one.guard_y + one.guard)
    planes = np.ascontiguousarray(one.planes[box[0] : box[1] + beyond_y, box[2] : box[3] + beyond_x])
    return WindowLayer(planes, one.scale, one.length_x, one.length_y, one.guard_x, one.guard_y, one.guard)
