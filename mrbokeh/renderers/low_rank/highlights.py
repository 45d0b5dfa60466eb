"""Highlights: pixels so much brighter than what surrounds them that the ripples of a short low-rank sum would show."""

from collections.abc import Callable, Iterable

import numpy as np
from jaxtyping import Float32

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
    """How much of each pixel's light has to be spread by its exact kernel: 0 for most, 1 for highlights.

    diameters_px: unsigned, 0 for pixels that take no part. unit_radius: of the aperture.
    A pixel's window is the square its light may reach (its radius rounded up to a power of two). In every channel two
    ratios are taken: value over mean of the window, and mean over the window of value over what a patch there has, where
    anything is lit at all. The share rises from 0 at ALONE (CONTRAST) to 1 at twice that. It depends on ratios only, so
    that light scaled as a whole is treated alike.
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
    """The share that one channel asks for; None where it is too even to ask for any."""
    import cv2

    from mrbokeh.renderers.bank._low_rank_pixels_numba import brightness, darkness, raise_shares

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
