"""Compiled visibility rays for baked lighting."""

import numpy as np
from numba import njit, prange

from datasets_scripts._traced_bodies_numba import FAST, PackedScene, nearest_hit


@njit(cache=True, fastmath=FAST, parallel=True)
def open_sky_and_sun(s: PackedScene, points: np.ndarray, sky: np.ndarray, sun: np.ndarray, reach_m: float) -> tuple[np.ndarray, np.ndarray]:
    """(P,) the share of sky rays that are free for reach_m (near hits count more), and the share of sun rays that are free."""
    everything = np.arange(s.quad_corner.shape[0] + s.sphere_centre.shape[0])
    sky_open, sun_open = np.empty(points.shape[0]), np.empty(points.shape[0])
    for p in prange(points.shape[0]):
        ox, oy, oz = points[p, 0], points[p, 1], points[p, 2]
        free = 0.0
        for i in range(sky.shape[0]):
            t = nearest_hit(s, everything, everything.shape[0], ox, oy, oz, sky[i, 0], sky[i, 1], sky[i, 2])[1]
            free += min(t / reach_m, 1.0)
        sky_open[p] = free / sky.shape[0]
        free = 0.0
        for i in range(sun.shape[0]):
            t = nearest_hit(s, everything, everything.shape[0], ox, oy, oz, sun[i, 0], sun[i, 1], sun[i, 2])[1]
            free += 1.0 if t > 1e6 else 0.0
        sun_open[p] = free / sun.shape[0]
    return sky_open, sun_open
