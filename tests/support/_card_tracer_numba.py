"""Rays through lens points to flat cards, and light from small lamps to the film, compiled.

Everything is in pixels of the sharp picture. A card's plane is affine in 1/depth, so its circle of confusion at the sharp
position q is `c = a + bx x + by y`, and lens point u sees q at the film point `p = q + u c / 2`. Both ways are exact.
"""

import math

import numpy as np

from mrbokeh.system.compiled import njit

FAST = {"nsz", "arcp", "contract"}
OUT, SOME, ALL = 0, 1, 2


@njit(cache=True, nogil=True, fastmath=FAST, inline="always")
def sharp_from_film(plane: np.ndarray, x: float, y: float, ux: float, uy: float) -> tuple[float, float]:
    """Return the place where the ray through film point (x, y) and lens point u meets the card."""
    half_coc = 0.5 * (plane[0] + plane[1] * x + plane[2] * y) / (1.0 + 0.5 * (plane[1] * ux + plane[2] * uy))
    return x - ux * half_coc, y - uy * half_coc


@njit(cache=True, nogil=True, fastmath=FAST, inline="always")
def _inside(solid: np.ndarray, tx: float, ty: float) -> bool:
    """Return whether the bilinear value of `solid` (H, W) at texel position (tx, ty) is above 0; outside the table nothing is."""
    if tx < 0.0 or ty < 0.0 or tx >= solid.shape[1] - 1 or ty >= solid.shape[0] - 1:
        return False
    i, j = int(tx), int(ty)
    first = solid[j, i]
    # Values are distances in pixels: this far from the edge the other three corners cannot change the sign.
    if first > 2.0 or first < -2.0:
        return first > 0.0
    fx, fy = tx - i, ty - j
    top = first + fx * (solid[j, i + 1] - first)
    bottom = solid[j + 1, i] + fx * (solid[j + 1, i + 1] - solid[j + 1, i])
    return top + fy * (bottom - top) > 0.0


@njit(cache=True, nogil=True, fastmath=FAST)
def _lamp_at(cells: np.ndarray, lamps: np.ndarray, margin_px: int, x: float, y: float) -> int:
    """Index of the lamp that covers sharp position (x, y), or -1; cells (H, W) says which one may."""
    i, j = int(x + margin_px), int(y + margin_px)
    if i < 0 or j < 0 or i >= cells.shape[1] or j >= cells.shape[0] or cells[j, i] < 0:
        return -1
    lamp = lamps[cells[j, i]]
    return cells[j, i] if (x - lamp[1]) ** 2 + (y - lamp[2]) ** 2 < lamp[3] ** 2 else -1


@njit(cache=True, nogil=True, inline="always")
def _noise(row: int, column: int) -> tuple[int, float, float]:
    """Return a large whole number and two numbers in [0, 1) of a pixel, alike for equal pixels and without a pattern."""
    mixed = np.uint64(row * 2654435761 + column * 40503 + 12345)
    mixed = (mixed ^ (mixed >> np.uint64(15))) * np.uint64(0x2C1B3C6D)
    mixed = (mixed ^ (mixed >> np.uint64(12))) * np.uint64(0x297A2D39)
    mixed = mixed ^ (mixed >> np.uint64(15))
    x, y = (mixed >> np.uint64(8)) & np.uint64(0xFFFF), (mixed >> np.uint64(24)) & np.uint64(0xFFFF)
    return int(mixed % np.uint64(1 << 20)), float(x) / 65536.0, float(y) / 65536.0


@njit(cache=True, nogil=True, fastmath=FAST, inline="always")
def _first_card(
    planes: np.ndarray,
    solid: np.ndarray,
    cells: np.ndarray,
    lamps: np.ndarray,
    reach: np.ndarray,
    geometry: tuple[int, int],
    film: tuple[float, float],
    lens: tuple[float, float],
) -> tuple[int, bool, float, float]:
    """Return (card or -1, whether a lamp is met on it, texel position) that the ray through a film and a lens point meets first."""
    margin_px, density = geometry
    for k in range(planes.shape[0]):
        if reach[k] == OUT:
            continue
        x, y = sharp_from_film(planes[k], film[0], film[1], lens[0], lens[1])
        tx, ty = (x + margin_px) * density - 0.5, (y + margin_px) * density - 0.5
        if reach[k] == ALL:
            return k, False, tx, ty
        if _lamp_at(cells[k], lamps, margin_px, x, y) >= 0:
            return k, True, tx, ty
        if _inside(solid[k], tx, ty):
            return k, False, tx, ty
    return -1, False, 0.0, 0.0


@njit(cache=True, nogil=True, fastmath=FAST, inline="always")
def _colour_at(texels: np.ndarray, tx: float, ty: float) -> tuple[float, float, float]:
    """Return the bilinear colour at a texel position."""
    i, j = int(tx), int(ty)
    fx, fy = tx - i, ty - j
    a, b, c, d = (1 - fx) * (1 - fy), fx * (1 - fy), (1 - fx) * fy, fx * fy
    red = a * texels[j, i, 0] + b * texels[j, i + 1, 0] + c * texels[j + 1, i, 0] + d * texels[j + 1, i + 1, 0]
    green = a * texels[j, i, 1] + b * texels[j, i + 1, 1] + c * texels[j + 1, i, 1] + d * texels[j + 1, i + 1, 1]
    blue = a * texels[j, i, 2] + b * texels[j, i + 1, 2] + c * texels[j + 1, i, 2] + d * texels[j + 1, i + 1, 2]
    return red, green, blue


@njit(cache=True, nogil=True)
def trace_rows(
    out: np.ndarray,
    coverage: np.ndarray,
    rows: tuple[int, int],
    planes: np.ndarray,
    solid: np.ndarray,
    colour: np.ndarray,
    cells: np.ndarray,
    lamps: np.ndarray,
    reach: np.ndarray,
    geometry: tuple[int, int],
    samples: np.ndarray,
    starts: np.ndarray,
) -> None:
    """Mean over lens and pixel of the card colours seen, into out (H, W, 4: RGB and coverage); lamps are black here.

    coverage: (H, W, K) share per card, or of size 0 where nobody asks. geometry: (margin in px, texels per px).
    reach: (H, W, K) OUT where no ray of the pixel can meet the card, ALL where every ray does, else SOME.
    samples: (N, 5) lens point (2), point in the pixel (2), weight; pixel by pixel another block starts[b]:starts[b + 1]
    of them, shifted within the pixel, so that their errors are noise and no pattern.
    """
    for row in range(rows[0], rows[1]):
        for column in range(out.shape[1]):
            number, shift_x, shift_y = _noise(row, column)
            block = number % (starts.shape[0] - 1)
            red, green, blue, covered, total = 0.0, 0.0, 0.0, 0.0, 0.0
            reach_here = reach[row, column]
            for n in range(starts[block], starts[block + 1]):
                fx, fy, weight = samples[n, 2] + shift_x, samples[n, 3] + shift_y, samples[n, 4]
                film = (column + fx - math.floor(fx), row + fy - math.floor(fy))
                lens = (samples[n, 0], samples[n, 1])
                total += weight
                k, on_lamp, tx, ty = _first_card(planes, solid, cells, lamps, reach_here, geometry, film, lens)
                if k < 0:
                    continue
                covered += weight
                if coverage.size > 0:
                    coverage[row, column, k] += weight
                if not on_lamp:
                    r, g, b = _colour_at(colour[k], tx, ty)
                    red, green, blue = red + weight * r, green + weight * g, blue + weight * b
            out[row, column, 0], out[row, column, 1] = red / total, green / total
            out[row, column, 2], out[row, column, 3] = blue / total, covered / total
            if coverage.size > 0:
                coverage[row, column] /= total


@njit(cache=True, nogil=True)
def add_lamp(
    out: np.ndarray,
    index: int,
    planes: np.ndarray,
    solid: np.ndarray,
    cells: np.ndarray,
    lamps: np.ndarray,
    reach: np.ndarray,
    geometry: tuple[int, int],
    samples: np.ndarray,
) -> None:
    """Add the light of one lamp to out (H, W, 4), followed from the lamp through the lens to the film.

    samples: (N, 5) lens point (2), point on the unit disc for the place on the lamp (2), weight. What stands in front hides
    the lamp, lens point by lens point. A ray meets its pixel with the area that the warp gives it: energy is exact.
    """
    margin_px, density = geometry
    height, width = out.shape[0], out.shape[1]
    card = int(lamps[index, 0])
    plane, radius_px = planes[card], lamps[index, 3]
    share = math.pi * radius_px**2 / samples[:, 4].sum()
    for n in range(samples.shape[0]):
        ux, uy = samples[n, 0], samples[n, 1]
        x, y = lamps[index, 1] + radius_px * samples[n, 2], lamps[index, 2] + radius_px * samples[n, 3]
        half_coc = 0.5 * (plane[0] + plane[1] * x + plane[2] * y)
        film_x, film_y = x + ux * half_coc, y + uy * half_coc
        column, row = int(math.floor(film_x)), int(math.floor(film_y))
        if column < 0 or row < 0 or column >= width or row >= height:
            continue
        hidden = False
        for k in range(card):
            if reach[row, column, k] == OUT:
                continue
            qx, qy = sharp_from_film(planes[k], film_x, film_y, ux, uy)
            tx, ty = (qx + margin_px) * density - 0.5, (qy + margin_px) * density - 0.5
            if _inside(solid[k], tx, ty) or _lamp_at(cells[k], lamps, margin_px, qx, qy) >= 0:
                hidden = True
                break
        if not hidden:
            weight = share * samples[n, 4] * (1.0 + 0.5 * (plane[1] * ux + plane[2] * uy))
            for c in range(3):
                out[row, column, c] += weight * lamps[index, 4 + c]


@njit(cache=True, nogil=True)
def transmission(vertices: np.ndarray, starts: np.ndarray, weights: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Sum of the weights of the outlines that hold each of the points (N, 2), by the even-odd rule."""
    result = np.zeros(points.shape[0])
    for n in range(points.shape[0]):
        x, y = points[n, 0], points[n, 1]
        for o in range(weights.shape[0]):
            inside = False
            j = starts[o + 1] - 1
            for i in range(starts[o], starts[o + 1]):
                x0, y0, x1, y1 = vertices[i, 0], vertices[i, 1], vertices[j, 0], vertices[j, 1]
                if (y0 > y) != (y1 > y) and x < x0 + (y - y0) * (x1 - x0) / (y1 - y0):
                    inside = not inside
                j = i
            if inside:
                result[n] += weights[o]
    return result
