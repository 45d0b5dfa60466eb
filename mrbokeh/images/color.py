"""Colour: transfer functions, primaries, tone mapping, and sRGB codes by table. Everything else works on scene-linear numbers."""

from functools import cache

import numpy as np
from jaxtyping import Float, Float32, Shaped, UInt8

from mrbokeh.system.resources import in_bands, workers

# Rec.709 / sRGB primaries with D65 white (IEC 61966-2-1); rows give X, Y, Z.
XYZ_from_rec709 = np.array([[0.4124564, 0.3575761, 0.1804375], [0.2126729, 0.7151522, 0.0721750], [0.0193339, 0.1191920, 0.9503041]])
rec709_from_XYZ = np.linalg.inv(XYZ_from_rec709)

_SHOULDER = 0.8


def srgb_to_linear(encoded: Float[np.ndarray, "*shape"]) -> Float32[np.ndarray, "*shape"]:
    """Convert sRGB-encoded values in [0, 1] to linear light (IEC 61966-2-1)."""
    encoded = np.asarray(encoded, np.float32)
    return np.where(encoded <= 0.04045, encoded / 12.92, ((np.maximum(encoded, 0.04045) + 0.055) / 1.055) ** 2.4).astype(np.float32)


def linear_to_srgb(linear: Float[np.ndarray, "*shape"]) -> Float32[np.ndarray, "*shape"]:
    """Convert linear light to sRGB-encoded values; the curve continues above 1, negatives stay on its straight foot."""
    linear = np.asarray(linear, np.float32)
    return np.where(linear <= 0.0031308, linear * 12.92, 1.055 * np.maximum(linear, 0.0031308) ** (1 / 2.4) - 0.055).astype(np.float32)


def luminance(rgb: Float[np.ndarray, "*batch 3"]) -> Float[np.ndarray, "*batch"]:
    """Return Y of linear Rec.709."""
    return rgb @ XYZ_from_rec709[1].astype(rgb.dtype)


def convert(rgb: Float[np.ndarray, "*batch 3"], target_from_source: Float[np.ndarray, "3 3"]) -> Float32[np.ndarray, "*batch 3"]:
    """Apply a 3x3 matrix of primaries to colours."""
    return (rgb @ np.asarray(target_from_source, rgb.dtype).T).astype(np.float32)


def tone_map(rgb: Float32[np.ndarray, "*shape"], exposure_stops: float = 0.0) -> Float32[np.ndarray, "*shape"]:
    """Map scene-linear light to displayable light in [0, 1]: identity up to 0.8, then highlights roll off towards 1."""
    exposed = np.maximum(rgb * np.float32(2.0**exposure_stops), 0.0)
    room = 1.0 - _SHOULDER
    rolled_off = 1.0 - room * np.exp(-(exposed - _SHOULDER) / room)
    return np.where(exposed <= _SHOULDER, exposed, rolled_off).astype(np.float32)


def display_rgb8(rgb: Float32[np.ndarray, "*shape"], exposure_stops: float = 0.0) -> UInt8[np.ndarray, "*shape"]:
    """Convert scene-linear light to 8-bit sRGB for people to look at."""
    return np.round(linear_to_srgb(tone_map(rgb, exposure_stops)) * 255.0).astype(np.uint8)


_SHIFT = {np.dtype(np.uint8): 15, np.dtype(np.uint16): 10}
"""Bits of a float that the table leaves out: few codes begin within one of its cells."""
_BAND_ROWS = 64
_ONE_BITS = 0x3F800000


def srgb_codes(rgb: Float32[np.ndarray, "height width channels"], dtype: type) -> Shaped[np.ndarray, "height width channels"]:
    """Encode linear light as sRGB integers (uint8 or uint16): 0 to 1 spans all codes, the rest is clipped, NaN is 0, inf the largest."""
    codes: np.ndarray = np.empty(rgb.shape, dtype)
    first, thresholds, most = _table(np.dtype(dtype))

    def work(top: int, end: int) -> None:
        for row in range(top, end):
            light = np.minimum(rgb[row], np.float32(1.0), dtype=np.float32)
            np.fmax(light, np.float32(0.0), out=light)
            code = first.take(light.view(np.int32) >> _SHIFT[np.dtype(dtype)])
            for _ in range(most):
                code += light >= thresholds.take(code)
            codes[row] = code

    with workers(rgb.shape[0] * rgb.shape[1]) as pool:
        in_bands(pool, rgb.shape[0], _BAND_ROWS, work)
    return codes


def plain_srgb_codes(linear: Float32[np.ndarray, "*shape"], dtype: type) -> Shaped[np.ndarray, "*shape"]:
    """Encode by formula: the slow reference from which the table of `srgb_codes` is built."""
    return np.round(np.clip(np.nan_to_num(linear_to_srgb(linear)), 0, 1) * np.iinfo(dtype).max).astype(dtype)


@cache
def _table(dtype: np.dtype) -> tuple[Shaped[np.ndarray, " cells"], Float32[np.ndarray, " codes"], int]:
    """Return the lookup table of `srgb_codes`: the code of the least value of each cell of floats from 0 to 1, the least value of
    each code's last, and how many codes at most begin within a cell.
    """
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
