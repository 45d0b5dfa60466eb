"""Compiled Gaussians over the screen, as in the papers: directly, recursively along a sheared axis, or by look-ups in a mip map.

`direct_gaussian` weighs every pixel for every other: the slow twin of the fast filters. `sheared_gaussian` is a recursive filter along
x and a plain one along a sheared axis (Eq. 9 and 10). `texture_gaussian` takes anisotropic look-ups in a mip map, as texture units
of graphics processors do (Eq. 2 to 4).
"""

import math

import numpy as np

from mrbokeh.renderers.layered_reconstruction._filter_numba import PIXEL_VARIANCE, axes, evened_out, reproject, sheared_axes, sheared_filter
from mrbokeh.renderers.layered_reconstruction._tile_data import Choice, Light, Partitions, Slope
from mrbokeh.system.compiled import njit

_LEAST_VARIANCE = 1e-3
_MOST_PROBES = 16
DIRECT, SHEARED, TEXTURE, TEXTURE_ONE_TAP, WINDOWS = 0, 1, 2, 3, 4
_LEAST_GAUSSIAN_VARIANCE = 1e-4


@njit(cache=True, nogil=True)
def filter_layer(out: np.ndarray, planes: np.ndarray, guard_x: int, guard_y: int, v: tuple[float, float, float], choice: Choice) -> None:
    kind = choice.kind
    if guard_x == 0 and guard_y == 0:
        out[:] = planes
    elif kind == SHEARED:
        sheared_gaussian(out, planes, guard_x, guard_y, v[0], v[1], v[2], choice.passes)
    elif kind == DIRECT:
        direct_gaussian(out, planes, guard_x, guard_y, v[0], v[1], v[2])
    else:
        sigma_u, sigma_v, theta = axes(v[0], v[1], v[2])
        texture_gaussian(
            out, planes, guard_x, guard_y, sigma_u, sigma_v, theta, choice.alpha, choice.tap_distance, 4 if kind == TEXTURE else 1
        )


@njit(cache=True, nogil=True)
def guard_px(variance: float, support: float) -> int:
    """Return the pixels around a tile that its filter needs; a Gaussian that ends within its pixel needs none."""
    return int(math.ceil(support * math.sqrt(variance))) if variance > 0.04 else 0


@njit(cache=True, nogil=True)
def gaussian_layer(layer: np.ndarray, left: int, top: int, j: int, partitions: Partitions, light: Light, choice: Choice) -> None:
    """Fill layer (h, w, C + 2), whose top left pixel is (left, top), with the filtered colour, opacity and weight of a partition."""
    height, width, channels = layer.shape
    a, b_x, b_y, v_xx, v_xy, v_yy = sheared_filter(partitions.sums[j], light.window, choice.sigma_x_px, choice.bandwidth)
    v_xx, v_yy = max(v_xx - PIXEL_VARIANCE, _LEAST_GAUSSIAN_VARIANCE), max(v_yy - PIXEL_VARIANCE, _LEAST_GAUSSIAN_VARIANCE)
    guard_x, guard_y = guard_px(v_xx, choice.support), guard_px(v_yy, choice.support)
    planes = np.zeros((height + 2 * guard_y, width + 2 * guard_x, channels + 1), np.float32)
    reproject(planes, left - guard_x, top - guard_y, Slope(a, b_x, b_y), j, partitions, light, choice.shared_out)
    planes = evened_out(planes, choice.enough)
    filter_layer(layer, planes, guard_x, guard_y, (v_xx, v_xy, v_yy), choice)


@njit(cache=True, nogil=True)
def direct_gaussian(out: np.ndarray, planes: np.ndarray, guard_x: int, guard_y: int, v_xx: float, v_xy: float, v_yy: float) -> None:
    """Fill out (h, w, C) from planes (h + 2 guard_y, w + 2 guard_x, C) by the Gaussian of covariance V, sampled at pixels, sum 1."""
    det = v_xx * v_yy - v_xy * v_xy
    kernel = np.zeros((2 * guard_y + 1, 2 * guard_x + 1), np.float32)
    if det > 1e-9:
        for j in range(-guard_y, guard_y + 1):
            for i in range(-guard_x, guard_x + 1):
                kernel[j + guard_y, i + guard_x] = math.exp(-0.5 * (v_yy * i * i - 2.0 * v_xy * i * j + v_xx * j * j) / det)
        kernel /= kernel.sum()
    else:
        kernel[guard_y, guard_x] = 1.0
    height, width, channels = out.shape
    for y in range(height):
        for x in range(width):
            for c in range(channels):
                out[y, x, c] = 0.0
            for j in range(2 * guard_y + 1):
                for i in range(2 * guard_x + 1):
                    weight = kernel[j, i]
                    if weight > 0.0:
                        for c in range(channels):
                            out[y, x, c] += weight * planes[y + j, x + i, c]


@njit(cache=True, nogil=True)
def feedback(variance_px2: float) -> float:
    """Return gamma of Eq. 10, such that forward and backward together have exactly this variance.

    The impulse response of both is (1 - gamma) / (1 + gamma) gamma^|n| with variance 2 gamma / (1 - gamma)^2. The paper's
    exp(-sqrt(2) / sigma) is the same for large sigma and 15 % too narrow at 1 px.
    """
    q = 1.0 + 1.0 / variance_px2
    return q - math.sqrt(q * q - 1.0)


@njit(cache=True, nogil=True)
def recursive_rows(planes: np.ndarray, variance_px2: float, passes: int) -> None:
    """Smooth planes (h, w, C) in place along x; beyond the borders there is nothing.

    Several passes share the variance; their sum comes nearer to a Gaussian. Forward and backward are run as one sum of
    decaying exponentials, f + b - in, so that the result is mirror symmetric at the borders too.
    """
    if variance_px2 < _LEAST_VARIANCE:
        return
    gamma = np.float32(feedback(variance_px2 / passes))
    gain = np.float32((1.0 - gamma) / (1.0 + gamma))
    height, width, channels = planes.shape
    forward = np.empty((width, channels), np.float32)
    carried = np.empty(channels, np.float32)
    for y in range(height):
        row = planes[y]
        for _ in range(passes):
            for c in range(channels):
                carried[c] = 0.0
            for x in range(width):
                for c in range(channels):
                    carried[c] = row[x, c] + gamma * carried[c]
                    forward[x, c] = carried[c]
            for c in range(channels):
                carried[c] = 0.0
            for x in range(width - 1, -1, -1):
                for c in range(channels):
                    behind = gamma * carried[c]
                    carried[c] = row[x, c] + behind
                    row[x, c] = gain * (forward[x, c] + behind)


@njit(cache=True, nogil=True)
def sheared_taps(s_v: float, beta: float, guard_y: int) -> tuple[np.ndarray, np.ndarray, float]:
    """Return weights along the sheared axis, the shift in x of each row, and the variance that linear interpolation adds along x."""
    weights, shifts = np.zeros(2 * guard_y + 1), np.zeros(2 * guard_y + 1)
    for j in range(-guard_y, guard_y + 1):
        weights[j + guard_y] = math.exp(-0.5 * (j / s_v) ** 2) if s_v > 1e-3 else (1.0 if j == 0 else 0.0)
        shifts[j + guard_y] = beta * j
    weights /= weights.sum()
    added = 0.0
    for j in range(len(weights)):
        part = shifts[j] - math.floor(shifts[j])
        added += weights[j] * part * (1.0 - part)
    return weights, shifts, added


@njit(cache=True, nogil=True)
def sheared_gaussian(
    out: np.ndarray, planes: np.ndarray, guard_x: int, guard_y: int, v_xx: float, v_xy: float, v_yy: float, passes: int
) -> None:
    """Fill out as direct_gaussian does; overwrites planes."""
    sigma_u, sigma_v, theta = axes(v_xx, v_xy, v_yy)
    s_u, s_v, beta = sheared_axes(sigma_u, sigma_v, theta)
    weights, shifts, added = sheared_taps(s_v, beta, guard_y)
    recursive_rows(planes, s_u * s_u - added, passes)
    height, width, channels = out.shape
    out[:] = 0.0
    last = planes.shape[1] - 1
    for j in range(len(weights)):
        weight = weights[j]
        if weight < 1e-6:
            continue
        whole = int(math.floor(shifts[j]))
        right = np.float32(weight * (shifts[j] - whole))
        left = np.float32(weight) - right
        for y in range(height):
            row = planes[y + j]
            for x in range(width):
                at = x + guard_x + whole
                if 0 <= at < last:
                    for c in range(channels):
                        out[y, x, c] += left * row[at, c] + right * row[at + 1, c]
                elif at == last:
                    for c in range(channels):
                        out[y, x, c] += left * row[at, c]


@njit(cache=True, nogil=True)
def mip_map(planes: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return all levels, each the mean of 2x2 of the one below (nothing beyond the border), in one flat array, with (start, h, w) of
    each.
    """
    height, width, channels = planes.shape
    levels, total = 1, height * width
    h, w = height, width
    while h > 1 or w > 1:
        h, w = (h + 1) // 2, (w + 1) // 2
        levels, total = levels + 1, total + h * w
    flat, places = np.zeros((total, channels), np.float32), np.zeros((levels, 3), np.int64)
    places[0, 1], places[0, 2] = height, width
    for y in range(height):
        for x in range(width):
            for c in range(channels):
                flat[y * width + x, c] = planes[y, x, c]
    for level in range(1, levels):
        below, h, w = places[level - 1, 0], places[level - 1, 1], places[level - 1, 2]
        start, half_h, half_w = below + h * w, (h + 1) // 2, (w + 1) // 2
        places[level, 0], places[level, 1], places[level, 2] = start, half_h, half_w
        for y in range(h):
            for x in range(w):
                for c in range(channels):
                    flat[start + (y // 2) * half_w + x // 2, c] += np.float32(0.25) * flat[below + y * w + x, c]
    return flat, places


@njit(cache=True, nogil=True)
def _add_bilinear(total: np.ndarray, flat: np.ndarray, place: np.ndarray, x: float, y: float, weight: float) -> None:
    """Add the level at texel coordinates (x, y), with centres at whole numbers."""
    start, height, width = place[0], place[1], place[2]
    column, row = int(math.floor(x)), int(math.floor(y))
    for j in range(2):
        for i in range(2):
            at_x, at_y = column + i, row + j
            if 0 <= at_x < width and 0 <= at_y < height:
                share = weight * (1.0 - abs(x - at_x)) * (1.0 - abs(y - at_y))
                for c in range(flat.shape[1]):
                    total[c] += share * flat[start + at_y * width + at_x, c]


@njit(cache=True, nogil=True)
def add_look_up(
    total: np.ndarray,
    flat: np.ndarray,
    places: np.ndarray,
    x: float,
    y: float,
    major_x: float,
    major_y: float,
    minor_px: float,
    weight: float,
) -> None:
    """Add one anisotropic look-up at the place (x, y) in pixels: trilinear probes side by side along the major axis.

    (major_x, major_y), minor_px: the footprint's axes as the derivatives ddx, ddy give them; at most 16 probes.
    One probe of a texel's width w has the variance w^2 / 4 (a box and the tent of the interpolation), so that a round footprint
    of the width ddx has ddx^2 / 4. The probes of a long one are weighted by a Gaussian (Heckbert's EWA) that gives it the same
    along its major axis; equal weights over the length ddx would give a third of it.
    """
    major_px = math.hypot(major_x, major_y)
    least = max(minor_px, 1.0)
    probes = min(_MOST_PROBES, max(1, int(math.ceil(2.0 * (major_px - least) / least - 1e-6))))
    texel_px = max(2.0 * major_px / (probes + 2.0), least) if probes == _MOST_PROBES else least
    level = min(max(math.log2(texel_px), 0.0), len(places) - 1.0)
    below = min(int(level), len(places) - 1)
    above, part_above = min(below + 1, len(places) - 1), level - below
    rest = max(0.25 * (major_px * major_px - texel_px * texel_px), 1e-6)
    gain = 0.0
    for probe in range(probes):
        gain += math.exp(-0.5 * (major_px * ((2.0 * probe + 1.0) / probes - 1.0)) ** 2 / rest)
    for probe in range(probes):
        along = (2.0 * probe + 1.0) / probes - 1.0
        at_x, at_y = x + along * major_x, y + along * major_y
        share = weight * math.exp(-0.5 * (along * major_px) ** 2 / rest) / gain
        for which, part in ((below, 1.0 - part_above), (above, part_above)):
            if part > 0.0:
                texel = 2.0**which
                _add_bilinear(total, flat, places[which], at_x / texel - 0.5, at_y / texel - 0.5, share * part)


@njit(cache=True, nogil=True)
def texture_gaussian(
    out: np.ndarray,
    planes: np.ndarray,
    guard_x: int,
    guard_y: int,
    sigma_u: float,
    sigma_v: float,
    theta: float,
    alpha: float,
    tap_distance: float,
    taps: int,
) -> None:
    """Fill out as direct_gaussian does. taps: 1, or 4 of a footprint smaller by tap_distance, that far from the centre along both axes
    (Fig. 4).
    """
    flat, places = mip_map(planes)
    cosine, sine = math.cos(theta), math.sin(theta)
    u_px, v_px = alpha * sigma_u, alpha * sigma_v
    size = 1.0
    if taps == 4:
        # A look-up of the width w has the variance w^2 / 4: with the taps' distance that makes less than sigma^2, made good here.
        size = 1.0 - tap_distance
        widening = 1.0 / (alpha * math.sqrt(0.25 * size * size + 0.5 * tap_distance * tap_distance))
        u_px, v_px = widening * u_px, widening * v_px
    height, width, channels = out.shape
    total = np.zeros(channels)
    for y in range(height):
        for x in range(width):
            total[:] = 0.0
            centre_x, centre_y = x + guard_x + 0.5, y + guard_y + 0.5
            for tap in range(taps):
                along_u = along_v = 0.0
                if taps == 4:
                    along_u = tap_distance * u_px * (1.0 if tap == 0 else -1.0 if tap == 1 else 0.0)
                    along_v = tap_distance * v_px * (1.0 if tap == 2 else -1.0 if tap == 3 else 0.0)
                at_x, at_y = centre_x + cosine * along_u - sine * along_v, centre_y + sine * along_u + cosine * along_v
                add_look_up(total, flat, places, at_x, at_y, size * u_px * cosine, size * u_px * sine, size * v_px, 1.0 / taps)
            for c in range(channels):
                out[y, x, c] = total[c]
