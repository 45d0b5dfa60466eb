"""Rays through single points of the pupil and what they meet in sharp layers, compiled.

A ray that ends in film pixel p and comes through the point u of the unit pupil meets a surface of signed circle of confusion c at
p - u c / 2 of its sharp picture.
"""

import numpy as np
from numba import njit

_STEPS = 3


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
    first: int,
    end: int,
) -> None:
    """Means over the pupil for the pixels places[which[first:end]], at the same rows of sums.

    All numbers are single precision. sums (N, 16): f (past the near), a (virtual coverage), f a, virtual light v (3), f v (3), f s (3:
    of the far), f (1 - a) s (3), f (1 - a). near_in_reach (H, W): whether any ray may meet something near. coc_px (3, H, W): near,
    virtual, far, continued to where each layer has nothing. pupil (K, 3): x, y, weight.
    """
    width = near_alpha.shape[1]
    seen, here, mean = np.empty(4, np.float32), np.empty(3, np.float32), np.empty(16, np.float32)
    weights = pupil[:, 2].sum()
    for i in which[first:end]:
        row, column = places[i] // width, places[i] % width
        y_px, x_px = np.float32(row + 0.5), np.float32(column + 0.5)
        is_near, far_is_still = near_in_reach[row, column], coc_px[2, row, column] == 0.0
        if far_is_still:
            _look(far_rgb, x_px, y_px, here)
        mean[:] = 0.0
        for k in range(len(pupil)):
            ux, uy, weight = pupil[k, 0], pupil[k, 1], pupil[k, 2]
            free = weight
            if is_near:
                x, y = _meet(coc_px[0], x_px, y_px, ux, uy)
                free *= np.float32(1.0) - _plane_at(near_alpha, x, y)
            x, y = _meet(coc_px[1], x_px, y_px, ux, uy)
            _look(virtual, x, y, seen)
            if not far_is_still:
                x, y = _meet(coc_px[2], x_px, y_px, ux, uy)
                _look(far_rgb, x, y, here)
            past = free * (np.float32(1.0) - seen[3])
            mean[0] += free
            mean[1] += weight * seen[3]
            mean[2] += free * seen[3]
            mean[15] += past
            for c in range(3):
                mean[3 + c] += weight * seen[c]
                mean[6 + c] += free * seen[c]
                mean[9 + c] += free * here[c]
                mean[12 + c] += past * here[c]
        for c in range(16):
            sums[i, c] = mean[c] / weights


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
    """Where a ray meets a surface, by steps that settle where it is smooth."""
    x, y = x_px, y_px
    for _ in range(_STEPS):
        row, column = min(max(int(y), 0), coc_px.shape[0] - 1), min(max(int(x), 0), coc_px.shape[1] - 1)
        half_px = np.float32(0.5) * coc_px[row, column]
        x, y = x_px - ux * half_px, y_px - uy * half_px
    return x, y


@njit(cache=True, nogil=True, fastmath=True)
def _corners(shape: tuple[int, ...], x: np.float32, y: np.float32) -> tuple[int, int, int, int, np.float32, np.float32]:
    """Rows and columns of the four pixel centres around a place, the border going on outwards, and the shares of the later ones."""
    x, y = (
        min(max(x - np.float32(0.5), np.float32(0.0)), np.float32(shape[1] - 1)),
        min(max(y - np.float32(0.5), np.float32(0.0)), np.float32(shape[0] - 1)),
    )
    left, top = int(x), int(y)
    return top, min(top + 1, shape[0] - 1), left, min(left + 1, shape[1] - 1), y - np.float32(top), x - np.float32(left)


@njit(cache=True, nogil=True, fastmath=True)
def _look(picture: np.ndarray, x: np.float32, y: np.float32, found: np.ndarray) -> None:
    """Bilinear between pixel centres."""
    top, low, left, right, down, along = _corners(picture.shape, x, y)
    a, b = (np.float32(1.0) - down) * (np.float32(1.0) - along), (np.float32(1.0) - down) * along
    c, d = down * (np.float32(1.0) - along), down * along
    for k in range(picture.shape[2]):
        found[k] = a * picture[top, left, k] + b * picture[top, right, k] + c * picture[low, left, k] + d * picture[low, right, k]


@njit(cache=True, nogil=True, fastmath=True)
def _plane_at(plane: np.ndarray, x: np.float32, y: np.float32) -> np.float32:
    top, low, left, right, down, along = _corners(plane.shape, x, y)
    upper = plane[top, left] + along * (plane[top, right] - plane[top, left])
    lower = plane[low, left] + along * (plane[low, right] - plane[low, left])
    return upper + down * (lower - upper)
