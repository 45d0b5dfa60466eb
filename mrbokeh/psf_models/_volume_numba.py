"""Photons in a homogeneous medium, compiled: Woodcock tracking and the Henyey-Greenstein phase function.

Random numbers come from a counter (SplitMix64, Steele, Lea and Flood 2014), so that a photon's path depends on the seed and
its number only.
"""

import numpy as np

from mrbokeh.system.compiled import njit

_GOLDEN = np.uint64(0x9E3779B97F4A7C15)
_FIRST, _SECOND = np.uint64(0xBF58476D1CE4E5B9), np.uint64(0x94D049BB133111EB)
_TO_UNIT = 1.0 / 9007199254740992.0


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
