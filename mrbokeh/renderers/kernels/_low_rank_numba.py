"""Compiled loops over pixels that prepare a low-rank scatter: which pixels are blurred, on which side, by which level, and how bright."""

import numpy as np

from mrbokeh.system.compiled import njit

SHARP, NOT_FINITE = 0, 1
IN_FRONT, BEHIND, NEGATIVE = 2, 4, 8
"""Flags of `prepare` and, NEGATIVE, of channels."""
NOT_A_LEVEL = -2  # neither a level nor one below a level


@njit(cache=True, nogil=True)
def prepare(
    out: np.ndarray, diameters_px: np.ndarray, values: np.ndarray, coc_px: np.ndarray, sharp_up_to_px: float, signed: np.ndarray
) -> int:
    """Split rows into sharp pixels (copied to out, which else becomes 0) and blurred ones (their signed diameters, else 0).

    A pixel without any value counts as sharp. signed (C,) is set where a channel has a negative value. Returns the flags.
    """
    height, width, channels = values.shape
    flags = SHARP
    for y in range(height):
        for x in range(width):
            lit = False
            for c in range(channels):
                lit = lit or values[y, x, c] != 0
                signed[c] = signed[c] or values[y, x, c] < 0
            blur_px = coc_px[y, x] if lit else np.float32(0)
            if not np.isfinite(blur_px):
                flags |= NOT_FINITE
            blurred = abs(blur_px) > sharp_up_to_px
            diameters_px[y, x] = blur_px if blurred else np.float32(0)
            if blurred:
                flags |= IN_FRONT if blur_px < 0 else BEHIND
            for c in range(channels):
                out[y, x, c] = np.float32(0) if blurred else values[y, x, c]
    return flags


@njit(cache=True, nogil=True)
def one_side(diameters_px: np.ndarray, sign: int) -> np.ndarray:
    """Return unsigned diameters of the pixels on one side of the focus, 0 elsewhere."""
    out = np.empty_like(diameters_px)
    for y in range(out.shape[0]):
        for x in range(out.shape[1]):
            out[y, x] = max(np.float32(sign) * diameters_px[y, x], np.float32(0))
    return out


@njit(cache=True, nogil=True)
def sort_into_levels(
    level: np.ndarray,
    upper: np.ndarray,
    used: np.ndarray,
    diameters_px: np.ndarray,
    exact: np.ndarray,
    begins_px: np.ndarray,
    per_px: np.ndarray,
) -> None:
    """Set level and share of the next level for every pixel with a diameter that is not summed exactly; NOT_A_LEVEL elsewhere.

    begins_px, per_px (S,): stretches of diameters and how many levels a pixel of diameter has in each. used: (levels,) is
    set where a level takes part.
    """
    offsets = np.zeros(begins_px.shape[0])
    for s in range(1, begins_px.shape[0]):
        offsets[s] = offsets[s - 1] + (begins_px[s] - begins_px[s - 1]) * per_px[s - 1]
    for y in range(level.shape[0]):
        for x in range(level.shape[1]):
            level[y, x], upper[y, x] = NOT_A_LEVEL, np.float32(0)
            diameter_px = diameters_px[y, x]
            if diameter_px > 0 and exact[y, x] < 1:
                s = begins_px.shape[0] - 1
                while diameter_px < begins_px[s]:
                    s -= 1
                position = offsets[s] + (diameter_px - begins_px[s]) * per_px[s]
                level[y, x] = int(position)
                upper[y, x] = position - int(position)
                used[level[y, x]] = True
                if upper[y, x] > 0:
                    used[level[y, x] + 1] = True


@njit(cache=True, nogil=True)
def level_spans(levels: np.ndarray, uppers: np.ndarray, tile_px: int) -> np.ndarray:
    """Return (H, tiles, 2): lowest and highest level that any pixel of a tile's row takes part in; (1, 0) if none does."""
    height, width = levels.shape
    spans = np.empty((height, (width + tile_px - 1) // tile_px, 2), np.int16)
    spans[..., 0], spans[..., 1] = 1, 0
    for y in range(height):
        for x in range(width):
            level = levels[y, x]
            if level == NOT_A_LEVEL:
                continue
            highest = level + 1 if uppers[y, x] > 0 else level
            span = spans[y, x // tile_px]
            if span[1] < span[0]:
                span[0], span[1] = level, highest
            else:
                span[0], span[1] = min(span[0], level), max(span[1], highest)
    return spans


@njit(cache=True, nogil=True)
def brightness(values: np.ndarray, channel: int, diameters_px: np.ndarray) -> tuple[np.ndarray, float, float]:
    """Return magnitudes of one channel where there is a diameter, 0 elsewhere, and the largest and the smallest of the whole."""
    height, width = diameters_px.shape
    out = np.empty((height, width), np.float32)
    largest, smallest = np.float32(0), np.float32(np.inf)
    for y in range(height):
        for x in range(width):
            out[y, x] = abs(values[y, x, channel]) if diameters_px[y, x] > 0 else np.float32(0)
            largest, smallest = max(largest, out[y, x]), min(smallest, out[y, x])
    return out, float(largest), float(smallest)


@njit(cache=True, nogil=True)
def darkness(patches: np.ndarray, bright: np.ndarray) -> None:
    """Overwrite the means of patches with their reciprocals, and with 0 where the pixel in the middle is not lit."""
    for y in range(bright.shape[0]):
        for x in range(bright.shape[1]):
            patches[y, x] = np.float32(1) / patches[y, x] if bright[y, x] > 0 and patches[y, x] > 0 else np.float32(0)


@njit(cache=True, nogil=True)
def raise_shares(
    shares: np.ndarray,
    bright: np.ndarray,
    means: np.ndarray,
    dark: np.ndarray,
    diameters_px: np.ndarray,
    above_px: float,
    up_to_px: float,
    alone: float,
    contrast: float,
) -> None:
    """Raise the share, if the diameter lies in (above_px, up_to_px], to how far the larger ratio is past its threshold, 0 to 1."""
    for y in range(bright.shape[0]):
        for x in range(bright.shape[1]):
            if above_px < diameters_px[y, x] <= up_to_px and bright[y, x] > 0:
                past_alone = bright[y, x] > alone * means[y, x]
                if past_alone or bright[y, x] * dark[y, x] > contrast:
                    ratio = bright[y, x] * dark[y, x] / contrast
                    if past_alone:
                        ratio = max(ratio, bright[y, x] / (alone * max(means[y, x], np.float32(1e-38))))
                    shares[y, x] = max(shares[y, x], min(np.float32(1), np.float32(ratio - 1)))
