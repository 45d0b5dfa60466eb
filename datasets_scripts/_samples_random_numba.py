"""Compiled quasi-random numbers: Owen-scrambled Sobol points of each pixel (see `truth_sampling`), and lens points from them."""

from typing import NamedTuple

import numpy as np

from mrbokeh.system.kernels import njit

DIMENSIONS = 5
PLACES = 4096
"""Film points per pixel and axis, so few that float32 holds them exactly in pictures of up to 2048 px."""
PER_BIT = 1.0 / 4294967296.0


class LensTable(NamedTuple):
    """Uniform points of a pupil from two numbers; see `samples_pupil.lens_table`."""

    y: np.ndarray
    x: np.ndarray
    light: np.ndarray


@njit(cache=True, nogil=True)
def lens_point(y: np.ndarray, x: np.ndarray, light: np.ndarray, along: float, across: float) -> tuple[float, float]:
    """`across` chooses the band and the height within it, `along` the place among its spans, both in [0, 1)."""
    scaled = across * y.shape[0]
    band = min(int(scaled), y.shape[0] - 1)
    k = 1
    while k < x.shape[1] - 1 and light[band, k] <= along:
        k += 1
    share = (along - light[band, k - 1]) / (light[band, k] - light[band, k - 1])
    return x[band, k - 1] + share * (x[band, k] - x[band, k - 1]), y[band, 0] + (scaled - band) * (y[band, 1] - y[band, 0])


@njit(cache=True, nogil=True)
def place(bits: np.uint32) -> float:
    """The middle of one of PLACES steps of a pixel's width."""
    return (float(bits >> np.uint32(20)) + 0.5) / PLACES


@njit(cache=True, nogil=True)
def _mixed(x: np.uint32) -> np.uint32:
    x = np.uint32((x ^ (x >> np.uint32(16))) * np.uint32(0x85EBCA6B))
    x = np.uint32((x ^ (x >> np.uint32(13))) * np.uint32(0xC2B2AE35))
    return np.uint32(x ^ (x >> np.uint32(16)))


@njit(cache=True, nogil=True)
def fill_seeds(item: int, first_stream: int, seeds: np.ndarray) -> None:
    """A seed of its own for each pixel (or lamp) and dimension, as `truth_sampling.scramble_seed` gives it."""
    for axis in range(seeds.shape[0]):
        stream = _mixed(np.uint32(first_stream + axis + 0x85EBCA6B))
        seeds[axis] = _mixed(np.uint32(np.uint32(np.uint32(item) * np.uint32(0x9E3779B9)) + stream))


@njit(cache=True, nogil=True)
def scrambled(mirrored_bits: np.uint32, seed: np.uint32) -> np.uint32:
    """`truth_sampling.owen_scrambled` of a 32-bit fraction given with its bits in reverse order."""
    x = np.uint32(mirrored_bits + seed)
    x = np.uint32(x ^ np.uint32(x * np.uint32(0x6C50B47C)))
    x = np.uint32(x ^ np.uint32(x * np.uint32(0xB82F1E52)))
    x = np.uint32(x ^ np.uint32(x * np.uint32(0xC7AFE638)))
    x = np.uint32(x ^ np.uint32(x * np.uint32(0x8D22F6E6)))
    x = np.uint32(((x >> np.uint32(1)) & np.uint32(0x55555555)) | np.uint32((x & np.uint32(0x55555555)) << np.uint32(1)))
    x = np.uint32(((x >> np.uint32(2)) & np.uint32(0x33333333)) | np.uint32((x & np.uint32(0x33333333)) << np.uint32(2)))
    x = np.uint32(((x >> np.uint32(4)) & np.uint32(0x0F0F0F0F)) | np.uint32((x & np.uint32(0x0F0F0F0F)) << np.uint32(4)))
    x = np.uint32(((x >> np.uint32(8)) & np.uint32(0x00FF00FF)) | np.uint32((x & np.uint32(0x00FF00FF)) << np.uint32(8)))
    return np.uint32((x >> np.uint32(16)) | np.uint32(x << np.uint32(16)))
