"""One tile after the other: its partitions, front to back, filtered and laid behind one another."""

import numpy as np

from mrbokeh.renderers.layered_reconstruction._compositing_numba import composite, own_means, share_out
from mrbokeh.renderers.layered_reconstruction._gaussian_layer_numba import WINDOWS, gaussian_layer
from mrbokeh.renderers.layered_reconstruction._partitions_numba import partitions_of_tile
from mrbokeh.renderers.layered_reconstruction._parts_numba import (
    box_of,
    coarse_ratio,
    cropped,
    laid,
    mean_of_parts,
    scale_by_coarse,
)
from mrbokeh.renderers.layered_reconstruction._tile_data import BLOCKS, Choice, Light, Partitions, Pupil
from mrbokeh.renderers.layered_reconstruction._window_layer_numba import lay_parts, window_layer
from mrbokeh.system.kernels import njit


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
            seen_past = in_parts(picture, left, top, partitions, light, choice, whole, 1)
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
    """As in_parts, but only for the pixels that need them; the others take the whole times, coarsely, parts over the whole."""
    height, width, _ = picture.shape
    layers = [window_layer(left, top, picture.shape, j, partitions, light, choice) for j in range(len(partitions.sums))]
    ratio, found = coarse_ratio(layers, picture.shape, whole, cells, choice.times, choice.part_tolerance)
    box = box_of(found, height, width)
    seen_past = np.empty((height, width), np.float32)
    if (box[1] - box[0]) * (box[3] - box[2]) < height * width:
        seen_past[:] = laid(picture, layers, whole, 1)
        scale_by_coarse(picture, ratio)
    if box[1] > 0:
        inside = picture[box[0] : box[1], box[2] : box[3]]
        seen_past[box[0] : box[1], box[2] : box[3]] = laid(inside, [cropped(one, box) for one in layers], cells, choice.times)
    return seen_past
