"""Compiled loops over EXR files: the pixels of deep layers, and the bytes of a ZIP block."""

import math

import numpy as np

from mrbokeh.system.compiled import njit

_THIN = 1e-30
# Light without alpha (a flame) has a place too: it counts this much where nothing else in the slice says where it is.
_PRESENT = 1e-9
_NOTHING = (0.0, 0.0, 0.0, 0.0)


@njit(cache=True, nogil=True)
def flatten_layers(
    starts: np.ndarray,
    rgba: np.ndarray,
    front_m: np.ndarray,
    back_m: np.ndarray,
    apart: float,
    marks: np.ndarray,
    out: np.ndarray,
    dioptres: np.ndarray,
) -> None:
    """Lay RGBA over one another per layer and pixel, front first, into out (N, P, 4), and the mean of 1 / depth into dioptres (N, P).

    rgba: (S, 4) float64. A pixel's next layer begins where the depth is farther by more than the part `apart`. marks: room for two
    numbers per sample of a pixel.
    """
    weights = np.zeros(out.shape[0])
    for pixel in range(starts.size - 1):
        first, end = starts[pixel], starts[pixel + 1]
        count = _marks(first, end, front_m, back_m, marks)
        weights[:] = 0.0
        index, begin_m = 0, math.inf
        for i in range(count):
            here_m = marks[i]
            if i > 0 and here_m == marks[i - 1]:
                continue
            following = i + 1
            while following < count and marks[following] == here_m:
                following += 1
            points = _points(first, end, here_m, rgba, front_m, back_m)
            next_m = marks[following] if following < count else here_m
            fog = _volumes(first, end, here_m, next_m, rgba, front_m, back_m) if following < count else _NOTHING
            if not (_is_there(points) or _is_there(fog)):
                continue
            if here_m > begin_m * (1.0 + apart) and index + 1 < weights.size:
                index, begin_m = index + 1, here_m
            begin_m = min(begin_m, here_m)
            _put(points, here_m, pixel, index, out, dioptres, weights)
            _put(fog, 0.5 * (here_m + next_m), pixel, index, out, dioptres, weights)
        for index in range(weights.size):
            if weights[index] > 0.0:
                dioptres[index, pixel] /= weights[index]


@njit(cache=True, nogil=True)
def _is_there(piece: tuple) -> bool:
    return piece[0] != 0.0 or piece[1] != 0.0 or piece[2] != 0.0 or piece[3] != 0.0


@njit(cache=True, nogil=True)
def _marks(first: int, end: int, front_m: np.ndarray, back_m: np.ndarray, marks: np.ndarray) -> int:
    """Fill marks with where anything begins or ends, sorted. Returns how many there are."""
    count = 0
    for s in range(first, end):
        marks[count] = front_m[s]
        count += 1
        if back_m[s] > front_m[s]:
            marks[count] = back_m[s]
            count += 1
    marks[:count].sort()
    return count


@njit(cache=True, nogil=True)
def _points(first: int, end: int, here_m: float, rgba: np.ndarray, front_m: np.ndarray, back_m: np.ndarray) -> tuple:
    """Merge samples without thickness at one depth."""
    total = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0)
    for s in range(first, end):
        if front_m[s] == here_m and back_m[s] <= here_m:
            total = _with(total, rgba[s], 1.0)
    return _merged(total)


@njit(cache=True, nogil=True)
def _volumes(first: int, end: int, here_m: float, next_m: float, rgba: np.ndarray, front_m: np.ndarray, back_m: np.ndarray) -> tuple:
    """Merge the pieces between two depths of all samples that reach through there."""
    total = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0)
    for s in range(first, end):
        if front_m[s] <= here_m and back_m[s] >= next_m:
            total = _with(total, rgba[s], (next_m - here_m) / (back_m[s] - front_m[s]))
    return _merged(total)


@njit(cache=True, nogil=True)
def _with(total: tuple, sample: np.ndarray, part: float) -> tuple:
    """Add a sample: optical depth and colour per optical depth add up; of opaque samples the colours, to be averaged."""
    r, g, b, depth, opaque_r, opaque_g, opaque_b, opaque = total
    alpha = min(max(sample[3], 0.0), 1.0)
    if alpha >= 1.0:
        return r, g, b, depth, opaque_r + sample[0], opaque_g + sample[1], opaque_b + sample[2], opaque + 1
    thickness = -math.log1p(-alpha)
    scale = part * (thickness / alpha if alpha > _THIN else 1.0)
    depth += part * thickness
    return r + scale * sample[0], g + scale * sample[1], b + scale * sample[2], depth, opaque_r, opaque_g, opaque_b, opaque


@njit(cache=True, nogil=True)
def _merged(total: tuple) -> tuple:
    """Return RGBA of what was added up."""
    r, g, b, depth, opaque_r, opaque_g, opaque_b, opaque = total
    if opaque > 0:
        return opaque_r / opaque, opaque_g / opaque, opaque_b / opaque, 1.0
    alpha = -math.expm1(-depth)
    scale = alpha / depth if depth > _THIN else 1.0
    return r * scale, g * scale, b * scale, alpha


@njit(cache=True, nogil=True)
def _put(piece: tuple, depth_m: float, pixel: int, index: int, out: np.ndarray, dioptres: np.ndarray, weights: np.ndarray) -> None:
    """Put a piece behind what its slice has already."""
    if not _is_there(piece):
        return
    r, g, b, alpha = piece
    free = 1.0 - out[index, pixel, 3]
    out[index, pixel, 0] += free * r
    out[index, pixel, 1] += free * g
    out[index, pixel, 2] += free * b
    out[index, pixel, 3] += free * alpha
    weight = free * alpha + _PRESENT
    dioptres[index, pixel] += weight / depth_m
    weights[index] += weight


@njit(cache=True, nogil=True)
def without_prediction(packed: np.ndarray) -> np.ndarray:
    """Undo the prediction of OpenEXR's ZIP blocks: bytes are stored as differences from the last, plus 128, even ones before odd ones."""
    result = np.empty(packed.size, np.uint8)
    half, value = (packed.size + 1) // 2, 128
    for i in range(half):
        value = (value + packed[i] + 128) & 255
        result[2 * i] = value
    for i in range(half, packed.size):
        value = (value + packed[i] + 128) & 255
        result[2 * (i - half) + 1] = value
    return result
