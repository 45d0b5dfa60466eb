"""Compiled low-rank scatter of a picture whose blur changes from pixel to pixel: levels, exact splats, McGraw's two passes.

Levels are summed per tile of the result, level by level, term by term. A tile is TILE_FLOATS numbers wide, so that one row of it is a
fixed count that the compiler turns into vector code. Its work (rows of one level's share of the picture, and one term's rows filtered
across) stays in the processor's cache. Exact splats take single pixels by tabulated 2D kernels. McGraw's passes go across with the
kernel of the source, and down with the kernel of the pixel that was reached.
"""

from typing import NamedTuple

import numpy as np

from mrbokeh.system.compiled import njit

TILE_FLOATS = 128
_ROWS_AT_ONCE = 4


class Source(NamedTuple):
    """Pixels to be scattered by levels. shares (H, W): how much of a pixel goes this way.

    levels (H, W) int16, uppers (H, W): the share `upper` of a pixel goes to the kernel of level + 1, the rest to that of its level.
    """

    values: np.ndarray
    shares: np.ndarray
    levels: np.ndarray
    uppers: np.ndarray
    spans: np.ndarray


class Kernels(NamedTuple):
    """Taps in the order in which a pixel of the result meets its sources: columns (levels, terms, 3 + K + 6), rows (levels, terms, K).

    K differs from level to level: radii_px and ranks say how much of it is used.
    """

    columns: np.ndarray
    rows: np.ndarray
    ranks: np.ndarray
    radii_px: np.ndarray


class SinglePixels(NamedTuple):
    """Pixels (N,) that are splatted one by one: `upper` of each by the kernel after `lower`, the rest by that one."""

    shares: np.ndarray
    ys: np.ndarray
    xs: np.ndarray
    lowers: np.ndarray
    uppers: np.ndarray


class TapTable(NamedTuple):
    """Kernels of (2 r + 1)^2 taps, kernel i from starts[i] on."""

    taps: np.ndarray
    starts: np.ndarray
    radii_px: np.ndarray


@njit(cache=True, nogil=True, fastmath={"contract"})
def _across(row: np.ndarray, line: np.ndarray, taps: np.ndarray, channels: int) -> None:
    """Set row[x] to the sum of taps[j] * line[x + j * channels]; four taps at once, or storing the row would cost more than adding."""
    row[:] = np.float32(0)
    count = taps.shape[0]
    whole = count - count % 4
    for j in range(0, whole, 4):
        a, b, c, d = taps[j], taps[j + 1], taps[j + 2], taps[j + 3]
        at = j * channels
        line0, line1 = line[at : at + TILE_FLOATS], line[at + channels : at + channels + TILE_FLOATS]
        at += 2 * channels
        line2, line3 = line[at : at + TILE_FLOATS], line[at + channels : at + channels + TILE_FLOATS]
        for x in range(TILE_FLOATS):
            row[x] += a * line0[x] + b * line1[x] + c * line2[x] + d * line3[x]
    for j in range(whole, count):
        a = taps[j]
        line0 = line[j * channels : j * channels + TILE_FLOATS]
        for x in range(TILE_FLOATS):
            row[x] += a * line0[x]


@njit(cache=True, nogil=True, fastmath={"contract"})
def _four_by_four(out: np.ndarray, across: np.ndarray, taps: np.ndarray) -> None:
    """Add to four rows of the result from four filtered rows; taps: the seven that lie between them, the middle one for row = row."""
    out0, out1, out2, out3 = out[0], out[1], out[2], out[3]
    in0, in1, in2, in3 = across[0], across[1], across[2], across[3]
    t0, t1, t2, t3, t4, t5, t6 = taps[0], taps[1], taps[2], taps[3], taps[4], taps[5], taps[6]
    for x in range(TILE_FLOATS):
        a, b, c, d = in0[x], in1[x], in2[x], in3[x]
        out0[x] += t3 * a + t4 * b + t5 * c + t6 * d
        out1[x] += t2 * a + t3 * b + t4 * c + t5 * d
        out2[x] += t1 * a + t2 * b + t3 * c + t4 * d
        out3[x] += t0 * a + t1 * b + t2 * c + t3 * d


@njit(cache=True, nogil=True)
def _down(out: np.ndarray, across: np.ndarray, lit: np.ndarray, padded_taps: np.ndarray, count: int) -> None:
    """Add to out[y] the sum of tap[j] * across[y + j]; padded_taps has 3 zeros before and 6 behind, so that no four need a case."""
    for y in range(0, out.shape[0], _ROWS_AT_ONCE):
        for at in range(y, y + count + 3, _ROWS_AT_ONCE):
            if lit[at] or lit[at + 1] or lit[at + 2] or lit[at + 3]:
                _four_by_four(out[y : y + 4], across[at : at + 4], padded_taps[at - y : at - y + 7])


@njit(cache=True, nogil=True)
def _stage(
    line: np.ndarray, values: np.ndarray, shares: np.ndarray, levels: np.ndarray, uppers: np.ndarray, left: int, pixels: int, level: int
) -> bool:
    """Set one level's share of a row of the picture from column `left` on, 0 beyond the frame; False if that is nothing."""
    line[:] = np.float32(0)
    channels = values.shape[1]
    lit = False
    for x in range(max(0, left), min(values.shape[0], left + pixels)):
        if levels[x] == level:
            weight = shares[x] * (np.float32(1) - uppers[x])
        elif levels[x] == level - 1:
            weight = shares[x] * uppers[x]
        else:
            continue
        if weight > 0:
            lit = True
            at = (x - left) * channels
            for c in range(channels):
                line[at + c] = weight * values[x, c]
    return lit


@njit(cache=True, nogil=True)
def _level_on_tile(
    sums: np.ndarray, lines: np.ndarray, lit: np.ndarray, across: np.ndarray, columns: np.ndarray, rows: np.ndarray, channels: int
) -> None:
    """Add all terms of one level: every lit line across, then down into the sums; columns with their zeros around them."""
    count = rows.shape[1]
    for term in range(rows.shape[0]):
        for y in range(lines.shape[0]):
            if lit[y]:
                _across(across[y], lines[y], rows[term], channels)
            else:
                across[y] = np.float32(0)
        _down(sums, across, lit, columns[term], count)


@njit(cache=True, nogil=True)
def _any_in_reach(spans: np.ndarray, top: int, bottom: int, left: int, right: int, level: int) -> bool:
    for y in range(max(0, top), min(spans.shape[0], bottom)):
        for tile in range(max(0, left), min(spans.shape[1], right)):
            if spans[y, tile, 0] <= level <= spans[y, tile, 1]:
                return True
    return False


@njit(cache=True, nogil=True)
def _stage_level(
    lines: np.ndarray, lit: np.ndarray, source: Source, top: int, bottom: int, tile: int, tile_px: int, radius_px: int, level: int
) -> bool:
    """Set one level's share of all rows of the picture that reach rows top:bottom of a tile; False if that is nothing."""
    values, shares, levels, uppers, spans = source
    tiles_away = (radius_px + tile_px - 1) // tile_px
    first, end = tile - tiles_away, tile + tiles_away + 1
    if not _any_in_reach(spans, top - radius_px, bottom + radius_px, first, end, level):
        return False
    left, pixels = tile * tile_px - radius_px, tile_px + 2 * radius_px
    any_lit = False
    for i in range(lines.shape[0]):
        y = top - radius_px + i
        lit[i] = (
            0 <= y < min(values.shape[0], bottom + radius_px)
            and _any_in_reach(spans, y, y + 1, first, end, level)
            and _stage(lines[i], values[y], shares[y], levels[y], uppers[y], left, pixels, level)
        )
        any_lit = any_lit or lit[i]
    return any_lit


@njit(cache=True, nogil=True)
def _add_tile(out: np.ndarray, sums: np.ndarray) -> None:
    channels = out.shape[2]
    for y in range(out.shape[0]):
        for x in range(out.shape[1]):
            for c in range(channels):
                out[y, x, c] += sums[y, x * channels + c]


@njit(cache=True, nogil=True)
def scatter_piece(out: np.ndarray, source: Source, kernels: Kernels, top: int, bottom: int, first_tile: int, end_tile: int) -> None:
    """Add to rows top:bottom and tiles first_tile:end_tile of out (H, W, C) what all levels throw there."""
    columns, rows, ranks, radii_px = kernels
    channels = source.values.shape[2]
    tile_px = TILE_FLOATS // channels
    size = bottom - top + (-(bottom - top)) % _ROWS_AT_ONCE
    longest = 2 * radii_px.max() + 1
    sums = np.empty((size, TILE_FLOATS), np.float32)
    across = np.empty((size + longest + 6, TILE_FLOATS), np.float32)
    lines = np.empty((across.shape[0], TILE_FLOATS + longest * channels), np.float32)
    lit = np.empty(across.shape[0], np.bool_)
    for tile in range(first_tile, end_tile):
        sums[:] = np.float32(0)
        for level in range(ranks.shape[0]):
            terms, count = ranks[level], 2 * radii_px[level] + 1
            used = size + count + 6
            if terms > 0 and _stage_level(lines[:used], lit[:used], source, top, bottom, tile, tile_px, radii_px[level], level):
                _level_on_tile(sums, lines[:used], lit[:used], across[:used], columns[level, :terms], rows[level, :terms, :count], channels)
        _add_tile(out[top:bottom, tile * tile_px : (tile + 1) * tile_px], sums)


@njit(cache=True, nogil=True)
def _blend(kernel: np.ndarray, table: TapTable, lower: int, upper: float, channels: int) -> int:
    """Write (1 - upper) of kernel `lower` and upper of the next into kernel, every tap once per channel; returns the radius."""
    taps, starts, radii_px = table
    above = lower + 1 if upper > 0 else lower
    radius_px = radii_px[above]
    size, inset = 2 * radius_px + 1, radius_px - radii_px[lower]
    below = 2 * radii_px[lower] + 1
    for j in range(size):
        for i in range(size):
            tap = upper * taps[starts[above] + j * size + i] if upper > 0 else np.float32(0)
            if 0 <= j - inset < below and 0 <= i - inset < below:
                tap += (np.float32(1) - upper) * taps[starts[lower] + (j - inset) * below + i - inset]
            at = (j * size + i) * channels
            for c in range(channels):
                kernel[at + c] = tap
    return radius_px


@njit(cache=True, nogil=True, fastmath={"contract"})
def _add_row(out: np.ndarray, taps: np.ndarray, light: np.ndarray) -> None:
    for i in range(out.shape[0]):
        out[i] += taps[i] * light[i]


@njit(cache=True, nogil=True)
def splat_pixels(out: np.ndarray, values: np.ndarray, pixels: SinglePixels, table: TapTable, top: int, left: int) -> None:
    """Add share * value * kernel of every listed pixel to out (h, w * C), whose first pixel lies at row `top`, column `left`.

    out must hold all the kernels. Pixels of equal diameter that follow one another share the blending of their kernel.
    """
    shares, ys, xs, lowers, uppers = pixels
    channels = values.shape[2]
    longest = 2 * table.radii_px.max() + 1
    kernel = np.empty(longest * longest * channels, np.float32)
    light = np.empty(longest * channels, np.float32)
    radius_px = 0
    for n in range(ys.shape[0]):
        if n == 0 or lowers[n] != lowers[n - 1] or uppers[n] != uppers[n - 1]:
            radius_px = _blend(kernel, table, lowers[n], uppers[n], channels)
        size = 2 * radius_px + 1
        for i in range(size):
            for c in range(channels):
                light[i * channels + c] = shares[n] * values[ys[n], xs[n], c]
        length = size * channels
        start = (xs[n] - left - radius_px) * channels
        for j in range(size):
            row = out[ys[n] - top - radius_px + j]
            _add_row(row[start : start + length], kernel[j * length : (j + 1) * length], light[:length])


@njit(cache=True, nogil=True)
def _blended(taps: np.ndarray, table: np.ndarray, position: float) -> None:
    """Set taps (K,) between two neighbouring rows of a table (levels, K)."""
    level = min(int(position), table.shape[0] - 2)
    upper = np.float32(position - level)
    for j in range(taps.shape[0]):
        taps[j] = (np.float32(1) - upper) * table[level, j] + upper * table[level + 1, j]


@njit(cache=True, nogil=True)
def _radius_px(radii_px: np.ndarray, position: float) -> int:
    return radii_px[min(int(np.ceil(position)), radii_px.shape[0] - 1)]


@njit(cache=True, nogil=True)
def across(
    middle: np.ndarray, values: np.ndarray, shares: np.ndarray, positions: np.ndarray, table: np.ndarray, radii_px: np.ndarray
) -> None:
    """Overwrite middle (h, W, C) with share * value of each pixel (h, W, C) thrown along its row by its own taps.

    positions (h, W): level of each pixel's diameter, a fraction between two rows of table (levels, K), whose taps lie
    around the middle of K, no farther than radii_px (levels,).
    """
    height, width, channels = values.shape
    taps = np.empty(table.shape[1], np.float32)
    centre = table.shape[1] // 2
    middle[:] = np.float32(0)
    for y in range(height):
        for x in range(width):
            if shares[y, x] > 0:
                _blended(taps, table, positions[y, x])
                radius_px = _radius_px(radii_px, positions[y, x])
                for to in range(max(0, x - radius_px), min(width, x + radius_px + 1)):
                    tap = shares[y, x] * taps[centre + to - x]
                    for c in range(channels):
                        middle[y, to, c] += tap * values[y, x, c]


@njit(cache=True, nogil=True)
def down(out: np.ndarray, middle: np.ndarray, positions: np.ndarray, table: np.ndarray, radii_px: np.ndarray) -> None:
    """Add middle (H, w, C) to out, each pixel thrown along its column by the taps of the place where it is."""
    height, width, channels = middle.shape
    taps = np.empty(table.shape[1], np.float32)
    centre = table.shape[1] // 2
    for y in range(height):
        for x in range(width):
            lit = False
            for c in range(channels):
                lit = lit or middle[y, x, c] != 0
            if lit:
                _blended(taps, table, positions[y, x])
                radius_px = _radius_px(radii_px, positions[y, x])
                for to in range(max(0, y - radius_px), min(height, y + radius_px + 1)):
                    tap = taps[centre + to - y]
                    for c in range(channels):
                        out[to, x, c] += tap * middle[y, x, c]
