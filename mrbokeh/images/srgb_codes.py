"""Scene-linear light as whole numbers of sRGB, by a table: the codes of `color.linear_to_srgb`, rounded, many times as fast."""

from functools import cache

import numpy as np
from jaxtyping import Float32, Shaped

from mrbokeh.images.color import linear_to_srgb, srgb_to_linear
from mrbokeh.system.workers import in_bands, workers

_SHIFT = {np.dtype(np.uint8): 15, np.dtype(np.uint16): 10}
"""Bits of a float that the table leaves out: few codes begin within one of its cells."""
_BAND_ROWS = 64
_ONE_BITS = 0x3F800000


def srgb_codes(rgb: Float32[np.ndarray, "height width channels"], dtype: type) -> Shaped[np.ndarray, "height width channels"]:
    """0 to 1 becomes 0 to the largest of dtype (uint8 or uint16); what is beyond is clipped, NaN is 0, inf the largest."""
    codes: np.ndarray = np.empty(rgb.shape, dtype)
    first, thresholds, most = _table(np.dtype(dtype))

    def work(top: int, end: int) -> None:
        light = np.minimum(rgb[top:end], np.float32(1.0), dtype=np.float32)
        np.fmax(light, np.float32(0.0), out=light)
        code = first.take(light.view(np.int32) >> _SHIFT[np.dtype(dtype)])
        for _ in range(most):
            code += light >= thresholds.take(code)
        codes[top:end] = code

    with workers(rgb.shape[0] * rgb.shape[1]) as pool:
        in_bands(pool, rgb.shape[0], _BAND_ROWS, work)
    return codes


def plain_srgb_codes(linear: Float32[np.ndarray, "*shape"], dtype: type) -> Shaped[np.ndarray, "*shape"]:
    """The slow twin."""
    return np.round(np.clip(np.nan_to_num(linear_to_srgb(linear)), 0, 1) * np.iinfo(dtype).max).astype(dtype)


@cache
def _table(dtype: np.dtype) -> tuple[Shaped[np.ndarray, " cells"], Float32[np.ndarray, " codes"], int]:
    """Return the code of the least value of each cell of floats from 0 to 1, the least value of each code's successor, infinite for the
    last, and how many codes at most begin within a cell."""
    top = np.iinfo(dtype).max
    guess = srgb_to_linear(((np.arange(top) + 0.5) / top).astype(np.float32)).view(np.int32)
    low, high = guess - 256, guess + 256
    wanted = np.arange(1, top + 1)
    while (low + 1 < high).any():
        middle = (low + high) // 2
        reached = plain_srgb_codes(middle.view(np.float32), dtype.type) >= wanted
        low, high = np.where(reached, low, middle), np.where(reached, middle, high)
    thresholds = np.append(high.view(np.float32), np.float32(np.inf))
    cells = (np.arange((_ONE_BITS >> _SHIFT[dtype]) + 1, dtype=np.int64) << _SHIFT[dtype]).astype(np.int32)
    first = np.searchsorted(thresholds, cells.view(np.float32), side="right")
    return first.astype(dtype), thresholds, int(np.diff(first).max())
