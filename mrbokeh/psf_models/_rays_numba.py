"""Rays of the simple, the combined and the stylized model, and photons in a homogeneous medium, compiled.

A ray lands half a circle of confusion times its lens point away; a disc that is swept along a line has its exact light per pixel. Photons
go by Woodcock tracking and the Henyey-Greenstein phase function. Their random numbers come from a counter (SplitMix64, Steele, Lea and
Flood 2014), so that a photon's path depends on the seed and its number only.
"""

import numpy as np

from mrbokeh.system.compiled import njit

_GOLDEN = np.uint64(0x9E3779B97F4A7C15)
_FIRST, _SECOND = np.uint64(0xBF58476D1CE4E5B9), np.uint64(0x94D049BB133111EB)
_TO_UNIT = 1.0 / 9007199254740992.0


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


@njit(cache=True, nogil=True)
def uniform(state: np.ndarray) -> float:
    """Return the next number in [0, 1) of state (1, uint64), and advance it."""
    state[0] += _GOLDEN
    z = state[0]
    z = (z ^ (z >> np.uint64(30))) * _FIRST
    z = (z ^ (z >> np.uint64(27))) * _SECOND
    return float((z ^ (z >> np.uint64(31))) >> np.uint64(11)) * _TO_UNIT


@njit(cache=True, nogil=True)
def start_photon(state: np.ndarray, seed: int, photon: int) -> None:
    """Set the state of a photon from seed and number, mixed once."""
    state[0] = np.uint64(seed) * _FIRST + np.uint64(photon) * _SECOND
    z = state[0]
    z = (z ^ (z >> np.uint64(33))) * _SECOND
    state[0] = z ^ (z >> np.uint64(29))


@njit(cache=True, nogil=True)
def free_path(state: np.ndarray, density_per_m: float, majorant_per_m: float) -> float:
    """Return metres to the next collision, by Woodcock tracking (1965); inf without a medium.

    Tentative flights go through the denser majorant; of their collisions a share density / majorant is real.
    """
    if density_per_m <= 0.0:
        return np.inf
    path_m = 0.0
    while True:
        path_m -= np.log(1.0 - uniform(state)) / majorant_per_m
        if uniform(state) * majorant_per_m < density_per_m:
            return path_m


@njit(cache=True, nogil=True)
def scattering_cosine(anisotropy: float, share: float) -> float:
    """Return the cosine between old and new direction at a share of the cumulated Henyey-Greenstein phase function (1941)."""
    if abs(anisotropy) < 1e-4:
        return 2.0 * share - 1.0
    part = (1.0 - anisotropy * anisotropy) / (1.0 - anisotropy + 2.0 * anisotropy * share)
    return min(1.0, max(-1.0, (1.0 + anisotropy * anisotropy - part * part) / (2.0 * anisotropy)))


@njit(cache=True, nogil=True)
def turn(direction: np.ndarray, cosine: float, azimuth: float) -> None:
    """Turn a unit direction (3) in place by an angle of this cosine; azimuth in radians about it."""
    x, y, z = direction[0], direction[1], direction[2]
    sine = np.sqrt(max(0.0, 1.0 - cosine * cosine))
    sign = 1.0 if z >= 0.0 else -1.0
    scale = -1.0 / (sign + z)
    across = x * y * scale
    along, aside = sine * np.cos(azimuth), sine * np.sin(azimuth)
    direction[0] = along * (1.0 + sign * x * x * scale) + aside * across + cosine * x
    direction[1] = along * sign * across + aside * (sign + y * y * scale) + cosine * y
    direction[2] = -along * sign * x - aside * y + cosine * z
    length = np.sqrt(direction[0] ** 2 + direction[1] ** 2 + direction[2] ** 2)
    direction /= length


@njit(cache=True, nogil=True)
def walk(
    state: np.ndarray,
    radius_m: float,
    density_per_m: float,
    majorant_per_m: float,
    anisotropy: float,
    place: np.ndarray,
    heading: np.ndarray,
) -> int:
    """Walk a photon from the middle of a ball of medium to its surface; fills place and heading (3 each), returns its collisions."""
    place[:] = 0.0
    heading[0], heading[1], heading[2] = 0.0, 0.0, 1.0
    collisions = 0
    while True:
        path_m = free_path(state, density_per_m, majorant_per_m)
        along = place[0] * heading[0] + place[1] * heading[1] + place[2] * heading[2]
        inside = radius_m * radius_m - (place[0] ** 2 + place[1] ** 2 + place[2] ** 2)
        root = np.sqrt(along * along + max(inside, 0.0))
        rest_m = root - along if along < 0.0 else max(inside, 0.0) / max(root + along, 1e-300)
        if path_m >= rest_m:
            for k in range(3):
                place[k] += rest_m * heading[k]
            return collisions
        for k in range(3):
            place[k] += path_m * heading[k]
        collisions += 1
        turn(heading, scattering_cosine(anisotropy, uniform(state)), 2.0 * np.pi * uniform(state))


@njit(cache=True, nogil=True)
def trace_photons(
    first: int,
    seed: int,
    radii_m: np.ndarray,
    density_per_m: float,
    majorant_per_m: float,
    anisotropy: float,
    cosines: np.ndarray,
    collisions: np.ndarray,
) -> None:
    """Trace a photon for each radius: cosine between its heading and the outward normal where it leaves the ball, and its collisions."""
    state, place, heading = np.zeros(1, np.uint64), np.empty(3), np.empty(3)
    for i in range(len(radii_m)):
        start_photon(state, seed, first + i)
        collisions[i] = walk(state, radii_m[i], density_per_m, majorant_per_m, anisotropy, place, heading)
        outward = place[0] * heading[0] + place[1] * heading[1] + place[2] * heading[2]
        cosines[i] = 1.0 if collisions[i] == 0 else min(1.0, outward / radii_m[i])


@njit(cache=True, nogil=True)
def add_to_rings(
    rings: np.ndarray, cosines: np.ndarray, collisions: np.ndarray, albedo: np.ndarray, focal_px: float, ring_px: float
) -> None:
    """Sort photons, with the light that albedo (C) leaves them, into rings (R, C) of width ring_px around the source; what
    lands beyond the last ring is dropped."""
    for i in range(len(cosines)):
        if cosines[i] > 0.0:
            sine = np.sqrt(max(0.0, 1.0 - cosines[i] * cosines[i]))
            ring = focal_px * sine / (cosines[i] * ring_px)
            if ring < rings.shape[0]:
                for c in range(rings.shape[1]):
                    rings[int(ring), c] += albedo[c] ** collisions[i]


@njit(cache=True, nogil=True)
def spread_rings(rings: np.ndarray, ring_px: float, kernel: np.ndarray) -> None:
    """Give each ring's light evenly round to the pixels of kernel (K, K, C): points at most an eighth of a pixel apart, those of an
    eighth of a turn with their seven mirror images."""
    centre = kernel.shape[0] // 2
    for ring in range(rings.shape[0]):
        radius = (ring + 0.5) * ring_px
        points = max(2, int(np.ceil(0.25 * np.pi * radius * 8.0)))
        for point in range(points):
            angle = 0.25 * np.pi * (point + 0.5) / points
            far, near = int(np.floor(0.5 + radius * np.cos(angle))), int(np.floor(0.5 + radius * np.sin(angle)))
            if far <= centre:
                for x, y in ((far, near), (near, far)):
                    for c in range(rings.shape[1]):
                        light = 0.125 * rings[ring, c] / points
                        kernel[centre + y, centre + x, c] += light
                        kernel[centre + y, centre - x, c] += light
                        kernel[centre - y, centre + x, c] += light
                        kernel[centre - y, centre - x, c] += light
