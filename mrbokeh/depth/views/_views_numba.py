"""Compiled loops of depth from several views.

A plane sweep's matching scores (warp a band of rows of a neighbour's picture, correlate it in windows, keep the best); surfaces carried
from one view into another; weighted medians, and semi-global aggregation of costs in 0..255 along eight directions (`guided_depth`).
"""

from typing import NamedTuple

import numpy as np

from mrbokeh.system.compiled import njit

_FAR = np.float32(1e9)
_UNSEEN = -2.0  # as plane_sweep.UNSEEN


class Reference(NamedTuple):
    """The picture (H, W) that is swept, with its statistics in windows, the ray of each pixel (H, W, 3) and its 1 / depth in the middle."""

    picture: np.ndarray
    mean: np.ndarray
    variance: np.ndarray
    rays: np.ndarray
    dioptres: np.ndarray


@njit(cache=True, nogil=True, error_model="numpy")
def _positions(rays: np.ndarray, dioptres: np.ndarray, offset: np.float32, view: np.ndarray, u: np.ndarray, v: np.ndarray) -> None:
    """Project the points of one row into the neighbour, in samples of its array; view is laid out as in `packed_view`."""
    for x in range(rays.shape[0]):
        a, b, d = rays[x, 0], rays[x, 1], dioptres[x] + offset
        z = view[6] * a + view[7] * b + view[8] + view[11] * d
        inverse = np.float32(1.0) / max(z, np.float32(1e-6))
        p = (view[0] * a + view[1] * b + view[2] + view[9] * d) * inverse
        q = (view[3] * a + view[4] * b + view[5] + view[10] * d) * inverse
        rr = p * p + q * q
        bend = np.float32(1.0) + rr * (view[16] + rr * view[17])
        u[x] = p * bend * view[12] + view[14]
        v[x] = q * bend * view[13] + view[15]


@njit(cache=True, nogil=True, error_model="numpy")
def _sampled(picture: np.ndarray, u: np.ndarray, v: np.ndarray, row: np.ndarray, seen: np.ndarray) -> None:
    """Sample bilinearly; positions outside take the border's value and are not seen."""
    height, width = picture.shape
    for x in range(u.shape[0]):
        seen[x] = u[x] >= 0.0 and v[x] >= 0.0 and u[x] <= width - 1 and v[x] <= height - 1
        across = u[x] if u[x] > 0.0 else np.float32(0.0)  # this way round NaN becomes 0
        down = v[x] if v[x] > 0.0 else np.float32(0.0)
        across, down = min(across, np.float32(width - 1)), min(down, np.float32(height - 1))
        i, j = min(int(across), width - 2), min(int(down), height - 2)
        s, t = across - np.float32(i), down - np.float32(j)
        top = picture[j, i] + s * (picture[j, i + 1] - picture[j, i])
        bottom = picture[j + 1, i] + s * (picture[j + 1, i + 1] - picture[j + 1, i])
        row[x] = top + t * (bottom - top)


@njit(cache=True, nogil=True, error_model="numpy")
def _add_row(sums: np.ndarray, reference: np.ndarray, row: np.ndarray, sign: float) -> None:
    for x in range(row.shape[0]):
        w = sign * row[x]
        sums[0, x] += w
        sums[1, x] += w * row[x]
        sums[2, x] += w * reference[x]


@njit(cache=True, nogil=True, error_model="numpy")
def _correlations(sums: np.ndarray, rows: int, radius: int, mean: np.ndarray, variance: np.ndarray, noise: float, out: np.ndarray) -> None:
    """Compute the zero-mean normalised correlation of the windows around one row from the sums of their columns."""
    width = sums.shape[1]
    w, ww, rw = 0.0, 0.0, 0.0
    for x in range(min(radius, width)):
        w += sums[0, x]
        ww += sums[1, x]
        rw += sums[2, x]
    for x in range(width):
        if x + radius < width:
            w += sums[0, x + radius]
            ww += sums[1, x + radius]
            rw += sums[2, x + radius]
        if x - radius > 0:
            w -= sums[0, x - radius - 1]
            ww -= sums[1, x - radius - 1]
            rw -= sums[2, x - radius - 1]
        share = 1.0 / (rows * (min(x + radius, width - 1) - max(x - radius, 0) + 1))
        average = w * share
        spread = max(ww * share - average * average, 0.0)
        out[x] = (rw * share - mean[x] * average) / np.sqrt((variance[x] + noise) * (spread + noise))


@njit(cache=True, nogil=True, error_model="numpy")
def score_neighbour(
    seen_from: Reference,
    offset: float,
    picture: np.ndarray,
    view: np.ndarray,
    rows: tuple[int, int],
    radius: int,
    noise: float,
    out: np.ndarray,
) -> None:
    """Compute the scores (rows, W) of the rows first <= y < end against one neighbour."""
    reference, mean, variance, rays, dioptres = seen_from
    height, width = reference.shape
    first, end = rows
    offset32 = np.float32(offset)
    u, v = np.empty(width, np.float32), np.empty(width, np.float32)
    warped = np.empty((2 * radius + 1, width), np.float32)
    seen = np.empty((2 * radius + 1, width), np.bool_)
    sums = np.zeros((3, width))
    for y in range(first - radius, end + radius):
        slot, old = y % (2 * radius + 1), y - 2 * radius - 1
        if old >= max(first - radius, 0):
            _add_row(sums, reference[old], warped[slot], -1.0)
        if 0 <= y < height:
            _positions(rays[y], dioptres[y], offset32, view, u, v)
            _sampled(picture, u, v, warped[slot], seen[slot])
            _add_row(sums, reference[y], warped[slot], 1.0)
        centre = y - radius
        if first <= centre:
            in_window = min(y, height - 1) - max(centre - radius, 0) + 1
            _correlations(sums, in_window, radius, mean[centre], variance[centre], noise, out[centre - first])
            for x in range(width):
                if not seen[centre % (2 * radius + 1), x]:
                    out[centre - first, x] = _UNSEEN


@njit(cache=True, nogil=True, error_model="numpy")
def mean_of_best(scores: np.ndarray, best: int, out: np.ndarray) -> None:
    """Average the best few of (N, rows, W) scores among the neighbours that see the point; _UNSEEN if none does."""
    count, rows, width = scores.shape
    kept = np.empty(best, np.float32)
    for y in range(rows):
        for x in range(width):
            kept[:] = _UNSEEN
            for n in range(count):
                score = scores[n, y, x]
                for place in range(best):
                    if score > kept[place]:
                        kept[place], score = score, kept[place]
            total, seen = np.float32(0.0), 0
            for place in range(best):
                if kept[place] > _UNSEEN:
                    total += kept[place]
                    seen += 1
            out[y, x] = total / seen if seen > 0 else _UNSEEN


@njit(cache=True, nogil=True, error_model="numpy")
def carry(
    rays: np.ndarray,
    dioptre: np.ndarray,
    trust: np.ndarray,
    view: np.ndarray,
    least: np.float32,
    there: np.ndarray,
    there_trust: np.ndarray,
) -> None:
    """Put each trusted pixel on the four around its place in another view; the nearest stays. view: as `packed_view`, a pinhole."""
    height, width = there.shape
    for y in range(dioptre.shape[0]):
        for x in range(dioptre.shape[1]):
            if trust[y, x] < least:
                continue
            a, b, d = rays[y, x, 0], rays[y, x, 1], dioptre[y, x]
            z = view[6] * a + view[7] * b + view[8] + view[11] * d
            if z <= np.float32(1e-6):
                continue
            u = (view[0] * a + view[1] * b + view[2] + view[9] * d) / z * view[12] + view[14]
            v = (view[3] * a + view[4] * b + view[5] + view[10] * d) / z * view[13] + view[15]
            if not (u > -1.0 and v > -1.0 and u < width and v < height):
                continue
            # Neighbours up to two pixels apart leave no gap.
            left, top = int(np.floor(u)), int(np.floor(v))
            nearness = d / z
            for row in range(max(top, 0), min(top + 2, height)):
                for column in range(max(left, 0), min(left + 2, width)):
                    if nearness > there[row, column]:
                        there[row, column] = nearness
                        there_trust[row, column] = trust[y, x]


@njit(cache=True, nogil=True, error_model="numpy")
def weighted_medians(
    values: np.ndarray,
    weights: np.ndarray,
    guide: np.ndarray,
    where: np.ndarray,
    radius: int,
    contrast: float,
    rows: tuple[int, int],
    out: np.ndarray,
) -> None:
    """Replace each pixel marked in `where`, of rows first <= y < end, by the weighted median of its window.

    See `guided_depth.weighted_medians`.
    """
    height, width = values.shape
    colours = guide.shape[2]
    found = np.empty((2 * radius + 1) ** 2, np.float32)
    share = np.empty((2 * radius + 1) ** 2, np.float32)
    for y in range(rows[0], rows[1]):
        for x in range(width):
            if not where[y, x]:
                continue
            count, total = 0, 0.0
            for j in range(max(y - radius, 0), min(y + radius + 1, height)):
                for i in range(max(x - radius, 0), min(x + radius + 1, width)):
                    difference = 0.0
                    for c in range(colours):
                        step = guide[j, i, c] - guide[y, x, c]
                        difference += step * step
                    found[count] = values[j, i]
                    share[count] = weights[j, i] * np.exp(-difference / (contrast * contrast))
                    total += share[count]
                    count += 1
            if total <= 0.0:
                continue
            order = np.argsort(found[:count])
            passed = 0.0
            for place in range(count):
                passed += share[order[place]]
                if passed >= 0.5 * total:
                    out[y, x] = found[order[place]]
                    break


@njit(cache=True, nogil=True, error_model="numpy")
def _step(before: np.ndarray, cost: np.ndarray, small: np.float32, large: np.float32, path: np.ndarray) -> None:
    """Compute the path cost of each label of this pixel from the previous one.

    Both arrays carry a margin of one on either side, and the least cost of all labels at their end.
    """
    count = cost.shape[0]
    cheapest = before[count + 2]
    jump = cheapest + large
    least = _FAR
    for label in range(count):
        best = min(min(before[label + 1], jump), min(before[label], before[label + 2]) + small)
        value = np.float32(cost[label]) + best - cheapest
        path[label + 1] = value
        least = min(least, value)
    path[count + 2] = least


@njit(cache=True, nogil=True, error_model="numpy")
def _sweep(
    costs: np.ndarray, guide: np.ndarray, direction: tuple[int, int], small: float, large: float, contrast: float, total: np.ndarray
) -> None:
    """Add the path costs of one direction; costs and total are (H, W, L)."""
    height, width, labels = costs.shape
    dx, dy = direction
    small32, large32 = np.float32(small), np.float32(large)
    above = np.full((width, labels + 3), _FAR, np.float32)
    row = np.full((width, labels + 3), _FAR, np.float32)
    start = np.full(labels + 3, np.float32(0.0))
    start[0], start[labels + 1] = _FAR, _FAR
    for step_y in range(height):
        y = step_y if dy >= 0 else height - 1 - step_y
        for step_x in range(width):
            x = step_x if dx >= 0 else width - 1 - step_x
            from_x, from_y = x - dx, y - dy
            if from_x < 0 or from_x >= width or from_y < 0 or from_y >= height:
                _step(start, costs[y, x], small32, large32, row[x])
            else:
                edge = abs(guide[y, x] - guide[from_y, from_x])
                penalty = max(large32 / (np.float32(1.0) + edge / np.float32(contrast)), small32)
                _step(row[from_x] if dy == 0 else above[from_x], costs[y, x], small32, penalty, row[x])
            for label in range(labels):
                total[y, x, label] += np.uint16(row[x, label + 1])
        above, row = row, above


@njit(cache=True, nogil=True, error_model="numpy")
def aggregate(costs: np.ndarray, guide: np.ndarray, small: float, large: float, contrast: float) -> np.ndarray:
    """Sum (H, W, L) uint8 costs over eight paths as uint16, rounded down path by path."""
    total = np.zeros(costs.shape, np.uint16)
    for direction in ((1, 0), (-1, 0), (0, 1), (0, -1), (1, 1), (-1, -1), (1, -1), (-1, 1)):
        _sweep(costs, guide, direction, small, large, contrast, total)
    return total


@njit(cache=True, nogil=True, error_model="numpy")
def winners(total: np.ndarray, apart: int, index: np.ndarray, margin: np.ndarray) -> None:
    """Find per pixel the fractional index of the cheapest label, and the lead over the cheapest one more than `apart` labels away."""
    height, width, labels = total.shape
    for y in range(height):
        for x in range(width):
            cost = total[y, x]
            best = 0
            for label in range(1, labels):
                if cost[label] < cost[best]:
                    best = label
            rival = np.float32(65535.0)
            for label in range(labels):
                if abs(label - best) > apart:
                    rival = min(rival, np.float32(cost[label]))
            here = np.float32(cost[best])
            margin[y, x] = rival - here
            index[y, x] = best
            if 0 < best < labels - 1:
                before, after = np.float32(cost[best - 1]), np.float32(cost[best + 1])
                bend = before + after - np.float32(2.0) * here
                if bend > 0:
                    index[y, x] += min(max(np.float32(0.5) * (before - after) / bend, np.float32(-0.5)), np.float32(0.5))
