"""Surfaces carried from one view into another, compiled."""

import numpy as np

from mrbokeh.system.compiled import njit


@njit(cache=True, nogil=True, error_model="numpy")
def carry(
    rays: np.ndarray,
    dioptre: np.ndarray,
    trust: np.ndarray,
    view: np.ndarray,
    least: np.float32,
    there: np.ndarray,
    there_trust: np.ndarray,
) -> None:
    """Put each trusted pixel on the four around its place in another view; the nearest stays. view: as `packed_view`, a pinhole."""
    height, width = there.shape
    for y in range(dioptre.shape[0]):
        for x in range(dioptre.shape[1]):
            if trust[y, x] < least:
                continue
            a, b, d = rays[y, x, 0], rays[y, x, 1], dioptre[y, x]
            z = view[6] * a + view[7] * b + view[8] + view[11] * d
            if z <= np.float32(1e-6):
                continue
            u = (view[0] * a + view[1] * b + view[2] + view[9] * d) / z * view[12] + view[14]
            v = (view[3] * a + view[4] * b + view[5] + view[10] * d) / z * view[13] + view[15]
            if not (u > -1.0 and v > -1.0 and u < width and v < height):
                continue
            # Neighbours up to two pixels apart leave no gap.
            left, top = int(np.floor(u)), int(np.floor(v))
            nearness = d / z
            for row in range(max(top, 0), min(top + 2, height)):
                for column in range(max(left, 0), min(left + 2, width)):
                    if nearness > there[row, column]:
                        there[row, column] = nearness
                        there_trust[row, column] = trust[y, x]
