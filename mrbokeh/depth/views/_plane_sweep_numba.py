"""Matching scores of a plane sweep, compiled: warp a band of rows of a neighbour's picture, correlate it in windows, keep the best."""

from typing import NamedTuple

import numpy as np

from mrbokeh.system.compiled import njit

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
