"""Lamps: pixels so much brighter than the mean that they are splatted tap by tap, so that the rest can be summed in whole numbers.

At most one pixel in as many outshines the mean so many times in one channel: all of their taps are a small share of dense splatting,
whatever the picture.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float32, Float64, Int

from mrbokeh.system.resources import workers

OUTSHINES_MEAN = 32.0
_ROWS_AT_ONCE = 64
_EVERY = 8  # rows whose mean stands for that of all; how many lamps there may be is no matter of a few percent

Codes = Int[np.ndarray, "height width"]
Values = Float32[np.ndarray, "height width channels"]


class Lamps(NamedTuple):
    """Which pixels are lamps, and how large light of the other pixels with sparse kernels is at most in each channel, without sign."""

    found: Bool[np.ndarray, "height width"]
    largest: Float32[np.ndarray, " channels"]


def lamps_among(values: Values, codes: Codes, sparse: Bool[np.ndarray, " kinds"]) -> Lamps:
    """The lamps among pixels whose code (-1 for none) is sparse."""
    from mrbokeh.renderers.spreadlets._lamps_numba import find_lamps

    limits = (OUTSHINES_MEAN * _mean(values, codes, sparse)).astype(np.float32)
    starts = range(0, len(codes), _ROWS_AT_ONCE)
    found, largest = np.zeros(codes.shape, np.bool_), np.zeros((len(starts), values.shape[2]), np.float32)

    def find(band: int) -> None:
        rows = slice(starts[band], starts[band] + _ROWS_AT_ONCE)
        find_lamps(found[rows], largest[band], values[rows], codes[rows], sparse, limits)

    with workers(codes.size) as pool:
        list(pool.map(find, range(len(starts))))
    return Lamps(found, largest.max(axis=0))


def _mean(values: Values, codes: Codes, sparse: Bool[np.ndarray, " kinds"]) -> Float64[np.ndarray, " channels"]:
    """Of light without sign of the sparse pixels, in some rows or, if there are none in these, in all."""
    from mrbokeh.renderers.spreadlets._lamps_numba import add_up

    sums = np.zeros(values.shape[2])
    for step in (_EVERY, 1):
        count = add_up(sums, values[::step], codes[::step], sparse)
        if count:
            return sums / count
    return sums


def lamps_among_plainly(values: Values, codes: Codes, sparse: Bool[np.ndarray, " kinds"]) -> Lamps:
    """The plain twin of `lamps_among`."""
    mine, light = (codes >= 0) & sparse[codes], np.abs(values)
    some = light[::_EVERY][mine[::_EVERY]]
    limits = OUTSHINES_MEAN * (some if some.size else light[mine]).mean(axis=0, dtype=np.float64)
    found = mine & (light > limits.astype(np.float32)).any(axis=2)
    return Lamps(found, light[mine & ~found].max(axis=0, initial=0.0))
