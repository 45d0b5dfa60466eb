"""Exact scatter of the pixels that a low-rank sum must not touch: which they are (highlights), and each by its own 2D kernel.

Highlights are pixels so much brighter than those around them that the ripples of a short low-rank sum would show.
"""

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from jaxtyping import Float32, Int

from mrbokeh.optics.aperture import Aperture
from mrbokeh.optics.psf import kernel_radius_px
from mrbokeh.renderers.bank.renderers import KernelOpening

_BEGINS_PX = np.array([0.0, 32.0, 64.0, 128.0, 256.0])
_KERNELS_PER_PX = np.array([16.0, 8.0, 4.0, 2.0, 1.0])
"""Where there are too many diameters for each to have its own kernel, kernels are tabulated: 1/16 px apart up to 32 px and so on.

A pixel then takes a blend of the two next to its own. No tap is off by more than 0.01 of the largest (up to 32 px; 0.04 at
128 px, where a step is 1/4 px), and no light goes farther than half a step beyond its circle.
"""
_MOST_OWN_KERNELS = 1024
_MOST_OWN_TAPS = 2**23
_BAND_PX = 32  # rows summed by themselves; fixed, so that the sum does not depend on the number of threads


@dataclass(frozen=True)
class _Tables:
    """Kernels as Kernels as taps: those of all kernels one after the other, each from its entry in `starts`; lowers (N,), uppers (N,):
    of every pixel.
    """

    taps: Float32[np.ndarray, " taps"]
    starts: Int[np.ndarray, " kernels"]
    radii_px: Int[np.ndarray, " kernels"]
    lowers: Int[np.ndarray, " pixels"]
    uppers: Float32[np.ndarray, " pixels"]


def scatter_exactly(
    out: Float32[np.ndarray, "height width channels"],
    values: Float32[np.ndarray, "height width channels"],
    shares: Float32[np.ndarray, "height width"],
    diameters_px: Float32[np.ndarray, "height width"],
    aperture: Aperture | KernelOpening,
    sign: int,
    each: Callable[[Callable, Iterable], Iterable] = map,
) -> None:
    """Add share * value * kernel of every pixel with a share above 0 to out; diameters_px unsigned, sign: of all of them."""
    ys, xs = np.nonzero(shares > 0)
    if not ys.size:
        return
    tables = _tables(diameters_px[ys, xs], aperture, sign)
    bounds = np.searchsorted(ys, np.arange(0, values.shape[0] + _BAND_PX, _BAND_PX))
    bands = [slice(a, b) for a, b in pairwise(bounds) if b > a]
    for band, top, left in each(lambda part: _band(values, shares, ys[part], xs[part], tables, part), bands):
        _add_inside(out, band, top, left)


def _tables(diameters_px: Float32[np.ndarray, " pixels"], aperture: Aperture | KernelOpening, sign: int) -> _Tables:
    """Return the kernel of every diameter in use if they are few, as for highlights; else kernels at fixed steps."""
    own_px, lowers = np.unique(diameters_px, return_inverse=True)
    taps_each = (2 * kernel_radius_px(float(own_px[-1]), aperture.unit_radius) + 1) ** 2
    if len(own_px) <= _MOST_OWN_KERNELS and len(own_px) * taps_each <= _MOST_OWN_TAPS:
        steps_px, uppers = own_px, np.zeros(diameters_px.shape, np.float32)
    else:
        stretch = np.searchsorted(_BEGINS_PX, diameters_px, side="right") - 1
        begins = np.concatenate([[0.0], np.cumsum(np.diff(_BEGINS_PX) * _KERNELS_PER_PX[:-1])])
        positions = begins[stretch] + (diameters_px - _BEGINS_PX[stretch]) * _KERNELS_PER_PX[stretch]
        floors = np.floor(positions).astype(np.int64)
        uppers = (positions - floors).astype(np.float32)
        used = np.unique(np.concatenate([floors, floors + 1]))
        lowers = np.searchsorted(used, floors)
        stretch = np.searchsorted(begins, used, side="right") - 1
        steps_px = _BEGINS_PX[stretch] + (used - begins[stretch]) / _KERNELS_PER_PX[stretch]
    kernels = [aperture.rasterize(sign * float(step_px)) for step_px in steps_px]
    taps = np.concatenate([psf.kernel.ravel() for psf in kernels]).astype(np.float32)
    starts = np.cumsum([0, *(psf.kernel.size for psf in kernels[:-1])])
    return _Tables(taps=taps, starts=starts, radii_px=np.array([psf.radius_px for psf in kernels]), lowers=lowers, uppers=uppers)


def _band(
    values: Float32[np.ndarray, "height width channels"],
    shares: Float32[np.ndarray, "height width"],
    ys: Int[np.ndarray, " pixels"],
    xs: Int[np.ndarray, " pixels"],
    tables: _Tables,
    part: slice,
) -> tuple[Float32[np.ndarray, "rows columns channels"], int, int]:
    """Return the light of a band of pixels on the smallest rectangle that holds it, and the row and column where that begins."""
    from mrbokeh.renderers.low_rank._filter_numba import SinglePixels, TapTable, splat_pixels

    lowers, uppers = tables.lowers[part], tables.uppers[part]
    reach_px = int(tables.radii_px[np.minimum(lowers + 1, len(tables.radii_px) - 1)].max())
    top, left = int(ys.min()) - reach_px, int(xs.min()) - reach_px
    height, width = int(ys.max()) + reach_px + 1 - top, int(xs.max()) + reach_px + 1 - left
    band = np.zeros((height, width * values.shape[2]), np.float32)
    pixels = SinglePixels(shares=shares[ys, xs], ys=ys, xs=xs, lowers=lowers, uppers=uppers)
    splat_pixels(band, values, pixels, TapTable(tables.taps, tables.starts, tables.radii_px), top, left)
    return band.reshape(height, width, values.shape[2]), top, left


def _add_inside(
    out: Float32[np.ndarray, "height width channels"], part: Float32[np.ndarray, "rows columns channels"], top: int, left: int
) -> None:
    """Add a part to out where it lies within."""
    y0, x0 = max(0, top), max(0, left)
    y1, x1 = min(out.shape[0], top + part.shape[0]), min(out.shape[1], left + part.shape[1])
    if y1 > y0 and x1 > x0:
        out[y0:y1, x0:x1] += part[y0 - top : y1 - top, x0 - left : x1 - left]


ALONE = 8.0
"""A pixel starts to count as alone where it is this many times the mean of its window (a point is as many times as it has pixels)."""
CONTRAST = 64.0
"""... and as a highlight where it is this many times its darker surroundings, times the share of the window that they take."""
LEAST_RADIUS_PX = 5
"""Smaller kernels are taken at full rank, which is cheap; they need no care."""
_PATCH_PX = 5  # surroundings are judged by patches of this size, or the noise of a single dark pixel would decide
_WINDOW_RADII_PX = tuple(4 * 2**i for i in range(1, 12))


def exact_share(
    values: Float32[np.ndarray, "height width channels"],
    diameters_px: Float32[np.ndarray, "height width"],
    unit_radius: float,
    each: Callable[[Callable, Iterable], Iterable] = map,
) -> Float32[np.ndarray, "height width"]:
    """Return how much of each pixel's light needs its exact kernel: 0 for most, 1 for highlights.

    diameters_px: unsigned, 0 for pixels that take no part. unit_radius: of the aperture. A pixel's window is the square its light may
    reach (its radius rounded up to a power of two). In every channel two ratios are taken: value over mean of the window, and mean over
    the window of value over what a patch there has, where anything is lit at all. The share rises from 0 at ALONE (CONTRAST) to 1 at
    twice that. It depends on ratios only, so that light scaled as a whole is treated alike.
    """
    if diameters_px.max() * unit_radius <= 2.0 * LEAST_RADIUS_PX - 1.0:
        return np.zeros(diameters_px.shape, np.float32)
    shares = each(lambda channel: _share(values, channel, diameters_px, unit_radius), range(values.shape[2]))
    raised = [share for share in shares if share is not None]
    return np.maximum.reduce(raised) if raised else np.zeros(diameters_px.shape, np.float32)


def _share(
    values: Float32[np.ndarray, "height width channels"],
    channel: int,
    diameters_px: Float32[np.ndarray, "height width"],
    unit_radius: float,
) -> Float32[np.ndarray, "height width"] | None:
    """Return the share that one channel asks for; None if it is too even to ask for any."""
    import cv2

    from mrbokeh.renderers.kernels._low_rank_numba import brightness, darkness, raise_shares

    bright, largest, smallest = brightness(values, channel, diameters_px)
    if largest <= ALONE / 4.0 * smallest:  # in a corner of the frame a quarter of the window is lit
        return None
    dark = cv2.boxFilter(bright, -1, (_PATCH_PX, _PATCH_PX), borderType=cv2.BORDER_CONSTANT)
    darkness(dark, bright)
    share = np.zeros_like(bright)
    for radius_px in _WINDOW_RADII_PX:
        above_px = (2 * max(radius_px // 2, LEAST_RADIUS_PX - 1) + 1) / unit_radius
        up_to_px = (2 * radius_px + 1) / unit_radius
        if not ((diameters_px > above_px) & (diameters_px <= up_to_px)).any():
            continue
        window = (2 * radius_px + 1, 2 * radius_px + 1)
        mean, mean_dark = (cv2.boxFilter(each, -1, window, borderType=cv2.BORDER_CONSTANT) for each in (bright, dark))
        raise_shares(share, bright, mean, mean_dark, diameters_px, above_px, up_to_px, ALONE, CONTRAST)
    return share
