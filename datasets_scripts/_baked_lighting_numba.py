"""Compiled visibility rays for baked lighting."""

import numpy as np
from numba import prange

from datasets_scripts._traced_bodies_numba import FAST, PackedScene, nearest_hit
from mrbokeh.system.kernels import njit


@njit(cache=True, fastmath=FAST, parallel=True)
def open_share(s: PackedScene, members: np.ndarray, points: np.ndarray, directions: np.ndarray, reach_m: float) -> np.ndarray:
    """(P,) the share of the rays from each point (P, 3) that meets none of the bodies `members` within reach_m.

    A nearer hit counts as open by distance / reach_m, so that a large reach gives a hard answer and a short one a soft one.
    """
    share = np.empty(points.shape[0])
    for p in prange(points.shape[0]):
        free = 0.0
        for i in range(directions.shape[0]):
            dx, dy, dz = directions[i, 0], directions[i, 1], directions[i, 2]
            t = nearest_hit(s, members, members.shape[0], points[p, 0], points[p, 1], points[p, 2], dx, dy, dz)[1]
            free += min(t / reach_m, 1.0)
        share[p] = free / directions.shape[0]
    return share
