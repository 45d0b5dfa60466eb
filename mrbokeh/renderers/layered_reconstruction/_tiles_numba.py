"""One tile after the other: its partitions, front to back, filtered and laid behind one another."""

import numpy as np
from numba import njit

from mrbokeh.renderers.layered_reconstruction._compositing_numba import composite, own_means, share_out
from mrbokeh.renderers.layered_reconstruction._gaussian_layer_numba import WINDOWS, gaussian_layer
from mrbokeh.renderers.layered_reconstruction._partitions_numba import partitions_of_tile
from mrbokeh.renderers.layered_reconstruction._tile_data import BLOCKS, Choice, Light, Partitions, Pupil
from mrbokeh.renderers.layered_reconstruction._window_layer_numba import lay_windows


@njit(cache=True, nogil=True)
def reconstruct_tiles(
    out: np.ndarray, tiles: np.ndarray, counts: np.ndarray, light: Light, choice: Choice, pupil: Pupil, cells: Pupil, buckets: int
) -> None:
    """Fill the pixels of these tiles of out (H, W, C), and counts (T, 2) of populated buckets and partitions.

    pupil: whole, for tiles of one partition, which hides nothing. cells: the same in parts.
    """
    place = np.full(buckets, -1, np.int32)
    for tile in tiles:
        partitions, touched, populated = partitions_of_tile(tile, light, choice, place)
        counts[tile, 0], counts[tile, 1] = populated, len(partitions.sums)
        if len(partitions.sums) > 1:
            reconstruct_tile(out, tile, partitions, light, choice, cells, choice.times)
        else:
            reconstruct_tile(out, tile, partitions, light, choice, pupil, 1)
        for bucket in touched:
            place[bucket] = -1


@njit(cache=True, nogil=True)
def reconstruct_tile(out: np.ndarray, tile: int, partitions: Partitions, light: Light, choice: Choice, pupil: Pupil, times: int) -> None:
    tile_px = light.tile_px
    left, top = (tile % light.columns) * tile_px, (tile // light.columns) * tile_px
    picture = out[top : top + tile_px, left : left + tile_px]
    height, width, channels = picture.shape
    pictures = np.zeros((len(pupil.shares), times, height, width, channels), np.float32)
    parts_past = np.ones(pictures.shape[:4], np.float32)
    layer = np.empty((height, width, channels + 2), np.float32)
    for j in range(len(partitions.sums)):
        if choice.kind == WINDOWS:
            lay_windows(pictures, parts_past, left, top, j, partitions, light, choice, pupil)
        else:
            gaussian_layer(layer, left, top, j, partitions, light, choice)
            composite(pictures[0, 0], parts_past[0, 0], layer)
    seen_past = mean_of_parts(picture, pictures, parts_past, pupil.shares)
    share_out(picture, seen_past)
    first, end = light.starts[tile * BLOCKS], light.starts[(tile + 1) * BLOCKS]
    own_means(picture, seen_past, left, top, first, end, light.geometry, light.values)


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
