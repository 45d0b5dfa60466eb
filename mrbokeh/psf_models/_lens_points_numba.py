"""Rays of the simple, the combined and the stylized model, compiled: each lands half a circle of confusion times its lens point away.

Also the exact light per pixel of a disc swept along a line.
"""

import numpy as np

from mrbokeh.system.compiled import njit


@njit(cache=True, nogil=True)
def opening_at(x: float, y: float, edges: np.ndarray, starts: np.ndarray, extent: float) -> float:
    """Return the weight of the opening at a lens point within `extent`: the signed weights of the edges that a ray to +x crosses.

    edges (E, 5): x0, y0, x1, y1 and the weight of what lies to the left of an edge that goes up (y1 > y0), with its sign
    turned for one that goes down; sorted into bands of equal height over -extent..extent, of which band b has those from
    starts[b] to starts[b + 1] (an edge is listed in every band that it touches).
    """
    bands = len(starts) - 1
    band = min(max(int((y + extent) * bands / (2.0 * extent)), 0), bands - 1)
    total = 0.0
    for index in range(starts[band], starts[band + 1]):
        x0, y0, x1, y1 = edges[index, 0], edges[index, 1], edges[index, 2], edges[index, 3]
        if (y0 > y) != (y1 > y) and x < x0 + (y - y0) * (x1 - x0) / (y1 - y0):
            total += edges[index, 4]
    return total


@njit(cache=True, nogil=True)
def trace_lens(
    kernel: np.ndarray, low_px: float, high_px: float, shares: np.ndarray, extent: float, edges: np.ndarray, starts: np.ndarray
) -> float:
    """Add rays (rays, 3) to kernel (K, K): lens points over the square of half width `extent`, diameters from low to high. Returns their
    light.
    """
    size = kernel.shape[0]
    centre = 0.5 * size
    light = 0.0
    for ray in range(len(shares)):
        u = (2.0 * shares[ray, 0] - 1.0) * extent
        v = (2.0 * shares[ray, 1] - 1.0) * extent
        weight = opening_at(u, v, edges, starts, extent)
        if weight != 0.0:
            half_px = 0.5 * (low_px + (high_px - low_px) * shares[ray, 2])
            column, row = int(np.floor(centre + half_px * u)), int(np.floor(centre + half_px * v))
            if 0 <= row < size and 0 <= column < size:
                kernel[row, column] += weight
                light += weight
    return light


@njit(cache=True, nogil=True)
def _half_disc(y: float, radius: float) -> float:
    """Return the integral of c(y) = sqrt(radius^2 - y^2) from 0 to y, |y| <= radius."""
    return 0.5 * (y * np.sqrt(max(radius * radius - y * y, 0.0)) + radius * radius * np.arcsin(min(max(y / radius, -1.0), 1.0)))


@njit(cache=True, nogil=True)
def _moment(a: float, y: float, half: float, radius: float, sign: float) -> float:
    """Return the integral of (a + sign c(y))^2 / 2 from 0 to y; half is `_half_disc` at y."""
    square = radius * radius
    return 0.5 * (a * a * y + 2.0 * sign * a * half + square * y - y * y * y / 3.0)


@njit(cache=True, nogil=True)
def _ramp(a: float, y: float, half: float, bound: float, half_bound: float, radius: float) -> float:
    """Return the integral from 0 to y >= 0 of max(a + c, 0)^2 / 2 - max(a - c, 0)^2 / 2, for |a| >= radius or with its bound.

    bound: sqrt(radius^2 - a^2), where a + c (for a < 0) or a - c (for a > 0) changes its sign; 0 for |a| >= radius.
    """
    if a <= 0.0:
        if -a >= radius:
            return 0.0
        return _moment(a, y, half, radius, 1.0) if y < bound else _moment(a, bound, half_bound, radius, 1.0)
    total = _moment(a, y, half, radius, 1.0)
    if a >= radius:
        return total - _moment(a, y, half, radius, -1.0)
    if y > bound:
        total -= _moment(a, y, half, radius, -1.0) - _moment(a, bound, half_bound, radius, -1.0)
    return total


@njit(cache=True, nogil=True)
def fill_capsule(kernel: np.ndarray, diameter_px: float, motion_px: float, weight: float) -> None:
    """Add weight times the light of a disc swept along x, centred, each pixel the exact integral over its area.

    At height y the disc spans [-c, c], c = sqrt(r^2 - y^2). Over time it is convolved along x with a box of the motion's
    length, over the pixel with a box of 1, so the light left of x is a second difference of ramps max(x +- c, 0)^2 / 2;
    over y they integrate in closed form. Symmetric in x and y: one quadrant is computed (positive x and y edges).
    """
    size = kernel.shape[0]
    middle = size // 2
    radius, length = 0.5 * max(diameter_px, 1e-3), max(motion_px, 1e-3)
    scale = weight / (np.pi * radius * radius * length)
    edges = np.empty(middle + 2)
    edges[0] = 0.0
    for index in range(middle + 1):
        edges[index + 1] = index + 0.5
    columns, rows = middle + 2, min(middle + 2, int(np.ceil(radius + 0.5)) + 1)
    ramps = np.zeros((rows, columns))
    for column in range(columns):
        for end in range(2):
            a = edges[column] + (0.5 - end) * length
            bound = np.sqrt(max(radius * radius - a * a, 0.0))
            half_bound = _half_disc(bound, radius)
            for row in range(rows):
                y = min(edges[row], radius)
                ramps[row, column] += (1.0 - 2.0 * end) * _ramp(a, y, _half_disc(y, radius), bound, half_bound, radius)
    for row in range(rows - 1):
        for column in range(columns - 1):
            if max(edges[column] - 0.5 * length, 0.0) ** 2 + edges[row] ** 2 >= radius * radius:
                break  # wholly outside; what the differences would leave there is rounding
            light = ramps[row + 1, column + 1] - ramps[row, column + 1] - ramps[row + 1, column] + ramps[row, column]
            # The middle row and column are cut in two by the axes, and their halves are equal.
            light *= scale * (2.0 if row == 0 else 1.0) * (2.0 if column == 0 else 1.0)
            kernel[middle + row, middle + column] += light
            if row:
                kernel[middle - row, middle + column] += light
            if column:
                kernel[middle + row, middle - column] += light
            if row and column:
                kernel[middle - row, middle - column] += light


@njit(cache=True, nogil=True)
def trace_capsule(kernel: np.ndarray, box: np.ndarray, shares: np.ndarray) -> int:
    """Count rays (rays, 5) in kernel (K, K): lens point of the disc, time, diameter and motion of the box. Returns how many landed."""
    size = kernel.shape[0]
    centre = 0.5 * size
    landed = 0
    for ray in range(len(shares)):
        radius, angle = np.sqrt(shares[ray, 0]), 2.0 * np.pi * shares[ray, 1]
        half_px = 0.5 * (box[0, 0] + (box[0, 1] - box[0, 0]) * shares[ray, 2])
        motion_px = box[1, 0] + (box[1, 1] - box[1, 0]) * shares[ray, 3]
        x = centre + half_px * radius * np.cos(angle) + motion_px * (shares[ray, 4] - 0.5)
        y = centre + half_px * radius * np.sin(angle)
        column, row = int(np.floor(x)), int(np.floor(y))
        if 0 <= row < size and 0 <= column < size:
            kernel[row, column] += 1.0
            landed += 1
    return landed


@njit(cache=True, nogil=True)
def _inverted(cumulative: np.ndarray, share: float) -> float:
    """Return where a rising polyline over 0, 1, 2, ... reaches `share`."""
    low = int(np.searchsorted(cumulative, share, side="right")) - 1
    low = min(max(low, 0), len(cumulative) - 2)
    rise = cumulative[low + 1] - cumulative[low]
    return low + (min((share - cumulative[low]) / rise, 1.0) if rise > 0.0 else 0.0)


@njit(cache=True, nogil=True)
def trace_picture(
    kernel: np.ndarray,
    low_px: float,
    high_px: float,
    shares: np.ndarray,
    origin: np.ndarray,
    unit: float,
    rows: np.ndarray,
    columns: np.ndarray,
) -> int:
    """Count rays (rays, 3) in kernel (K, K) for diameters from low to high; lens points are drawn in proportion to the picture's light.

    origin (x, y): the centre of the pupil in the picture; unit: pupil radii per pixel of the picture. rows (H + 1) and columns
    (H, W + 1): light above each row, and left of each column within a row, both from 0 to 1.
    """
    size = kernel.shape[0]
    centre = 0.5 * size
    landed = 0
    for ray in range(len(shares)):
        y = _inverted(rows, shares[ray, 0])
        x = _inverted(columns[min(int(y), len(columns) - 1)], shares[ray, 1])
        half_px = 0.5 * (low_px + (high_px - low_px) * shares[ray, 2])
        column = int(np.floor(centre + half_px * unit * (x - origin[0])))
        row = int(np.floor(centre + half_px * unit * (y - origin[1])))
        if 0 <= row < size and 0 <= column < size:
            kernel[row, column] += 1.0
            landed += 1
    return landed
