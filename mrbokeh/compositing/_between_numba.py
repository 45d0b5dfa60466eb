"""Rays through single points of the pupil and what they meet in sharp layers, and the search of edge colours, compiled.

A ray that ends in film pixel p and comes through the point u of the unit pupil meets a surface of signed circle of confusion c at
p - u c / 2 of its sharp picture.
"""

import numpy as np

from mrbokeh.system.compiled import njit

_ROUND = 1e-12
_SPREAD = 6e-5
"""Least variance of a side, in a scale in which the mean level is a half: that of a noise of 3 %."""


@njit(cache=True, nogil=True)
def nearness(
    found: np.ndarray,
    places: np.ndarray,
    rgb: np.ndarray,
    sides: np.ndarray,
    half_px: int,
    first: int,
    end: int,
) -> None:
    """Rows first to end of found (N, 2): where the pixel's colour lies from the far side's mean (0) to the near one's (1) on Fisher's
    line, and the square of the distance of the means in standard deviations; 0 where one side has no pixel in the window.

    sides (H, W): 1 certainly near, 2 certainly far, 0 neither.
    """
    height, width = sides.shape
    sums, mixed = np.empty((3, 4)), np.empty((3, 3))
    for i in range(first, end):
        y, x = places[i] // width, places[i] % width
        top, bottom, left, right = max(0, y - half_px), min(height, y + half_px + 1), max(0, x - half_px), min(width, x + half_px + 1)
        level = _level(rgb, sides, top, bottom, left, right)
        sums[:], mixed[:] = 0.0, 0.0
        _means(sums, rgb, sides, top, bottom, left, right, level)
        found[i, 0], found[i, 1] = 0.0, 0.0
        if sums[1, 3] < 1.0 or sums[2, 3] < 1.0 or level <= 0.0:
            continue
        _spread(mixed, sums, rgb, sides, top, bottom, left, right, level)
        a, b, c = sums[1, 0] - sums[2, 0], sums[1, 1] - sums[2, 1], sums[1, 2] - sums[2, 2]
        u, v, w = _solved(mixed, a, b, c)
        apart = u * a + v * b + w * c
        along = 0.0
        for channel, line in enumerate((u, v, w)):
            value = rgb[y, x, channel]
            along += line * (value / (value + level) - sums[2, channel])
        found[i, 0], found[i, 1] = along / max(apart, _ROUND), apart


@njit(cache=True, nogil=True)
def _level(rgb: np.ndarray, sides: np.ndarray, top: int, bottom: int, left: int, right: int) -> float:
    """Mean light of the pixels that belong to a side."""
    total, count = 0.0, 0
    for y in range(top, bottom):
        for x in range(left, right):
            if sides[y, x] != 0:
                total += rgb[y, x, 0] + rgb[y, x, 1] + rgb[y, x, 2]
                count += 3
    return total / count if count > 0 else 0.0


@njit(cache=True, nogil=True)
def _means(sums: np.ndarray, rgb: np.ndarray, sides: np.ndarray, top: int, bottom: int, left: int, right: int, level: float) -> None:
    """Mean compressed colour of each side, and how many pixels it has."""
    for y in range(top, bottom):
        for x in range(left, right):
            side = sides[y, x]
            if side != 0:
                sums[side, 3] += 1.0
                for c in range(3):
                    sums[side, c] += rgb[y, x, c] / (rgb[y, x, c] + level)
    for side in range(1, 3):
        for c in range(3):
            sums[side, c] /= max(sums[side, 3], 1.0)


@njit(cache=True, nogil=True)
def _spread(
    mixed: np.ndarray, means: np.ndarray, rgb: np.ndarray, sides: np.ndarray, top: int, bottom: int, left: int, right: int, level: float
) -> None:
    """Covariance within a side, the mean of both."""
    for y in range(top, bottom):
        for x in range(left, right):
            side = sides[y, x]
            if side != 0:
                share = 0.5 / means[side, 3]
                for c in range(3):
                    off = rgb[y, x, c] / (rgb[y, x, c] + level) - means[side, c]
                    for d in range(c + 1):
                        mixed[c, d] += share * off * (rgb[y, x, d] / (rgb[y, x, d] + level) - means[side, d])
    for c in range(3):
        mixed[c, c] += _SPREAD
        for d in range(c):
            mixed[d, c] = mixed[c, d]


@njit(cache=True, nogil=True)
def _solved(matrix: np.ndarray, a: float, b: float, c: float) -> tuple[float, float, float]:
    """Solve three equations by cofactors."""
    m = matrix
    p, q, r = m[1, 1] * m[2, 2] - m[1, 2] ** 2, m[0, 2] * m[1, 2] - m[0, 1] * m[2, 2], m[0, 1] * m[1, 2] - m[0, 2] * m[1, 1]
    s, t, u = m[0, 0] * m[2, 2] - m[0, 2] ** 2, m[0, 1] * m[0, 2] - m[0, 0] * m[1, 2], m[0, 0] * m[1, 1] - m[0, 1] ** 2
    size = max(m[0, 0] * p + m[0, 1] * q + m[0, 2] * r, _ROUND * _ROUND)
    return (p * a + q * b + r * c) / size, (q * a + s * b + t * c) / size, (r * a + t * b + u * c) / size


_STEPS = 3
_NONE, _HALF, _ONE = np.float32(0.0), np.float32(0.5), np.float32(1.0)


@njit(cache=True, nogil=True, fastmath=True)
def gather(
    sums: np.ndarray,
    places: np.ndarray,
    which: np.ndarray,
    near_alpha: np.ndarray,
    near_in_reach: np.ndarray,
    virtual: np.ndarray,
    far_rgb: np.ndarray,
    coc_px: np.ndarray,
    pupil: np.ndarray,
) -> None:
    """Compute means over the pupil for the pixels places[which], at the same rows of sums.

    All numbers are single precision. sums (N, 16): f (past the near), a (virtual coverage), f a, virtual light v (3), f v (3), f s (3:
    of the far), f (1 - a) s (3), f (1 - a). near_in_reach (H, W): whether any ray may meet something near. coc_px (3, H, W): near,
    virtual, far, continued to where each layer has nothing. pupil (K, 3): x, y, weight.
    """
    width = near_alpha.shape[1]
    free, past, mean = np.empty(len(pupil), np.float32), np.empty(len(pupil), np.float32), np.empty(16, np.float32)
    rays = np.ascontiguousarray(pupil.T)
    total = rays[2].sum()
    for i in which:
        row, column = places[i] // width, places[i] % width
        for ray in range(len(pupil)):
            free[ray] = rays[2, ray]
        if near_in_reach[row, column]:
            _past_near(free, near_alpha, coc_px[0], row, column, rays)
        mean[0] = free.sum()
        _virtual_means(mean, past, free, virtual, coc_px[1], row, column, rays)
        if coc_px[2, row, column] == _NONE:
            _still_far(mean, far_rgb, row, column)
        else:
            _far_means(mean, past, free, far_rgb, coc_px[2], row, column, rays)
        for channel in range(16):
            sums[i, channel] = mean[channel] / total


@njit(cache=True, nogil=True, fastmath=True)
def _past_near(free: np.ndarray, near_alpha: np.ndarray, coc_px: np.ndarray, row: int, column: int, rays: np.ndarray) -> None:
    """Multiply each ray (x, y, weight: 3 K) by its share that gets past the near things.

    This loop and the next two hold nothing but numbers, so that many rays are followed at once.
    """
    here_px, x_px, y_px = coc_px[row, column], np.float32(column + 0.5), np.float32(row + 0.5)
    for k in range(len(free)):
        x, y = _meet_from(coc_px, here_px, x_px, y_px, rays[0, k], rays[1, k])
        free[k] *= _ONE - _plane_at(near_alpha, x, y)


@njit(cache=True, nogil=True, fastmath=True)
def _virtual_means(
    mean: np.ndarray, past: np.ndarray, free: np.ndarray, virtual: np.ndarray, coc_px: np.ndarray, row: int, column: int, rays: np.ndarray
) -> None:
    """Set the sums of what rays meet of the virtual surface, and what of each gets past that too."""
    here_px, x_px, y_px = coc_px[row, column], np.float32(column + 0.5), np.float32(row + 0.5)
    covered, covered_free, beyond = _NONE, _NONE, _NONE
    red, green, blue, red_free, green_free, blue_free = _NONE, _NONE, _NONE, _NONE, _NONE, _NONE
    for k in range(len(free)):
        x, y = _meet_from(coc_px, here_px, x_px, y_px, rays[0, k], rays[1, k])
        corners, weight = _corners(virtual.shape, x, y), rays[2, k]
        r, g, b, alpha = (
            _channel_at(virtual, corners, 0),
            _channel_at(virtual, corners, 1),
            _channel_at(virtual, corners, 2),
            _channel_at(virtual, corners, 3),
        )
        past[k] = free[k] * (_ONE - alpha)
        covered, covered_free, beyond = covered + weight * alpha, covered_free + free[k] * alpha, beyond + past[k]
        red, green, blue = red + weight * r, green + weight * g, blue + weight * b
        red_free, green_free, blue_free = red_free + free[k] * r, green_free + free[k] * g, blue_free + free[k] * b
    mean[1], mean[2], mean[15] = covered, covered_free, beyond
    mean[3], mean[4], mean[5], mean[6], mean[7], mean[8] = red, green, blue, red_free, green_free, blue_free


@njit(cache=True, nogil=True, fastmath=True)
def _far_means(
    mean: np.ndarray, past: np.ndarray, free: np.ndarray, far_rgb: np.ndarray, coc_px: np.ndarray, row: int, column: int, rays: np.ndarray
) -> None:
    """Set the sums of the far light that rays see past the near things, and past near and virtual ones."""
    here_px, x_px, y_px = coc_px[row, column], np.float32(column + 0.5), np.float32(row + 0.5)
    red, green, blue, red_past, green_past, blue_past = _NONE, _NONE, _NONE, _NONE, _NONE, _NONE
    for k in range(len(free)):
        x, y = _meet_from(coc_px, here_px, x_px, y_px, rays[0, k], rays[1, k])
        corners = _corners(far_rgb.shape, x, y)
        r, g, b = _channel_at(far_rgb, corners, 0), _channel_at(far_rgb, corners, 1), _channel_at(far_rgb, corners, 2)
        red, green, blue = red + free[k] * r, green + free[k] * g, blue + free[k] * b
        red_past, green_past, blue_past = red_past + past[k] * r, green_past + past[k] * g, blue_past + past[k] * b
    mean[9], mean[10], mean[11], mean[12], mean[13], mean[14] = red, green, blue, red_past, green_past, blue_past


@njit(cache=True, nogil=True, fastmath=True)
def _still_far(mean: np.ndarray, far_rgb: np.ndarray, row: int, column: int) -> None:
    """Set the sums of far light that is in focus: all rays of the pixel see one point of it."""
    for c in range(3):
        mean[9 + c], mean[12 + c] = mean[0] * far_rgb[row, column, c], mean[15] * far_rgb[row, column, c]


@njit(cache=True, nogil=True)
def follow(
    through_one: np.ndarray,
    through_both: np.ndarray,
    light: tuple[int, int, float, float, float, float],
    one_alpha: np.ndarray,
    one_coc_px: np.ndarray,
    two_alpha: np.ndarray,
    two_coc_px: np.ndarray,
    pupil: np.ndarray,
) -> None:
    """Add the light of one pixel, (row, column, signed circle of confusion, r, g, b), where it arrives past one layer and past both."""
    row, column, light_coc_px, red, green, blue = light
    rgb = (red, green, blue)
    height, width = one_alpha.shape
    weights = pupil[:, 2].sum()
    for k in range(len(pupil)):
        ux, uy = pupil[k, 0], pupil[k, 1]
        x_px, y_px = column + 0.5 + ux * light_coc_px * 0.5, row + 0.5 + uy * light_coc_px * 0.5
        x, y = _meet(one_coc_px, x_px, y_px, ux, uy)
        one = pupil[k, 2] / weights * (1.0 - _plane_at(one_alpha, x, y))
        x, y = _meet(two_coc_px, x_px, y_px, ux, uy)
        both = one * (1.0 - _plane_at(two_alpha, x, y))
        left, top = int(np.floor(x_px - 0.5)), int(np.floor(y_px - 0.5))
        right_share, low_share = x_px - 0.5 - left, y_px - 0.5 - top
        for dy in range(2):
            for dx in range(2):
                if 0 <= top + dy < height and 0 <= left + dx < width:
                    share = (low_share if dy else 1.0 - low_share) * (right_share if dx else 1.0 - right_share)
                    for c in range(3):
                        through_one[top + dy, left + dx, c] += share * one * rgb[c]
                        through_both[top + dy, left + dx, c] += share * both * rgb[c]


@njit(cache=True, nogil=True, fastmath=True)
def _meet(coc_px: np.ndarray, x_px: np.float32, y_px: np.float32, ux: np.float32, uy: np.float32) -> tuple[np.float32, np.float32]:
    """Return the place at which a ray meets a surface, by steps that settle where it is smooth."""
    return _meet_from(coc_px, _nearest(coc_px, x_px, y_px), x_px, y_px, ux, uy)


@njit(cache=True, nogil=True, fastmath=True)
def _meet_from(
    coc_px: np.ndarray, here_px: np.float32, x_px: np.float32, y_px: np.float32, ux: np.float32, uy: np.float32
) -> tuple[np.float32, np.float32]:
    """Return the place at which a ray meets a surface. here_px: the circle of confusion of the pixel that the ray ends in."""
    half_px = _HALF * here_px
    for _ in range(_STEPS - 1):
        half_px = _HALF * _nearest(coc_px, x_px - ux * half_px, y_px - uy * half_px)
    return x_px - ux * half_px, y_px - uy * half_px


@njit(cache=True, nogil=True, fastmath=True)
def _nearest(plane: np.ndarray, x: np.float32, y: np.float32) -> np.float32:
    row, column = min(max(y, _NONE), np.float32(plane.shape[0] - 1)), min(max(x, _NONE), np.float32(plane.shape[1] - 1))
    return plane[np.uint32(np.int32(row)), np.uint32(np.int32(column))]


@njit(cache=True, nogil=True, fastmath=True)
def _corners(
    shape: tuple[int, ...], x: np.float32, y: np.float32
) -> tuple[np.uint32, np.uint32, np.uint32, np.uint32, np.float32, np.float32]:
    """Rows and columns of the four pixel centres around a place, the border going on outwards, and the shares of the later ones."""
    last_row, last_column = np.float32(shape[0] - 1), np.float32(shape[1] - 1)
    x, y = min(max(x - _HALF, _NONE), last_column), min(max(y - _HALF, _NONE), last_row)
    left, top = np.int32(x), np.int32(y)
    right, low = left + np.int32(x < last_column), top + np.int32(y < last_row)
    return np.uint32(top), np.uint32(low), np.uint32(left), np.uint32(right), y - np.float32(top), x - np.float32(left)


@njit(cache=True, nogil=True, fastmath=True)
def _channel_at(
    picture: np.ndarray, corners: tuple[np.uint32, np.uint32, np.uint32, np.uint32, np.float32, np.float32], channel: int
) -> np.float32:
    """Bilinear between pixel centres."""
    top, low, left, right, down, along = corners
    upper = (_ONE - along) * picture[top, left, channel] + along * picture[top, right, channel]
    lower = (_ONE - along) * picture[low, left, channel] + along * picture[low, right, channel]
    return (_ONE - down) * upper + down * lower


@njit(cache=True, nogil=True, fastmath=True)
def _plane_at(plane: np.ndarray, x: np.float32, y: np.float32) -> np.float32:
    top, low, left, right, down, along = _corners(plane.shape, x, y)
    upper = plane[top, left] + along * (plane[top, right] - plane[top, left])
    lower = plane[low, left] + along * (plane[low, right] - plane[low, left])
    return upper + down * (lower - upper)
