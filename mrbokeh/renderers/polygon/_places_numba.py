"""Corners of an aperture as places in the ring of polygon_differences."""

import numpy as np

from mrbokeh.system.kernels import njit


@njit(cache=True)
def lay_out(
    steps: np.ndarray,
    places: np.ndarray,
    turned: np.ndarray,
    planes: np.ndarray,
    ring: tuple[int, int],
    laid: tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray],
) -> None:
    """Set step (corners, 2), place (corners, 4), plane and below (corners,) of mrbokeh.renderers.polygon._ring_numba.Corners.

    The first four are those of mrbokeh.renderers.polygon.tables.CrossedCorners. ring: cells to a row, elements to a plane.
    Lines count forwards here; crossing 0 of a corner that is turned lies one line on, one step back.
    """
    (stride, plane_elements), (step, place, plane, below) = ring, laid
    for corner in range(len(planes)):
        plane[corner] = planes[corner] * plane_elements
        for edge in range(2):
            elements = 4 * (steps[corner, edge, 0] + stride * steps[corner, edge, 1])
            step[corner, edge] = -elements if turned[corner, edge] else elements
            plane[corner] -= elements if turned[corner, edge] else 0
        for k in range(4):
            place[corner, k] = 4 * (places[corner, k, 0] + stride * places[corner, k, 1])
        below[corner] = place[corner].max() + 4 * stride
