"""Points spread evenly over the pupil, and how much an opening lets through at each."""

from functools import lru_cache

import numpy as np
from jaxtyping import Float64

from mrbokeh.optics.aperture import Aperture

# The root of x^3 = x + 1: steps of 1/g and 1/g^2 fill the square evenly (Roberts 2018, the R2 sequence).
_PLASTIC_NUMBER = 1.32471795724474602596


@lru_cache(maxsize=512)
def pupil_points(aperture: Aperture, count: int) -> Float64[np.ndarray, "points 3"]:
    """Return x, y in the unit pupil and weight; a plain aperture. The first n of them are evenly spread too.

    count: number of open points at least.
    """
    tried = count
    while True:
        steps = np.arange(1, tried + 1)[:, None] / np.array([_PLASTIC_NUMBER, _PLASTIC_NUMBER**2])
        points = (2.0 * ((0.5 + steps) % 1.0) - 1.0) * aperture.unit_radius
        weights = transmission(aperture, points)
        is_open = np.abs(weights) > 1e-9
        if is_open.sum() >= count:
            found = np.column_stack([points, weights])[is_open][:count]
            return np.ascontiguousarray(found)
        tried *= 2


def transmission(aperture: Aperture, points: Float64[np.ndarray, "points 2"]) -> Float64[np.ndarray, " points"]:
    """Sum of the weights of the outlines that a point lies within (crossings of a ray to the right are odd)."""
    x, y = points[:, :1], points[:, 1:]
    total = np.zeros(len(points))
    for outline, weight in zip(aperture.outlines, aperture.weights, strict=True):
        (x0, y0), (x1, y1) = outline.T, np.roll(outline, -1, axis=0).T
        spans = (y0 <= y) != (y1 <= y)
        rise = np.where(y1 == y0, 1.0, y1 - y0)
        crosses = spans & (x < x0 + (y - y0) * (x1 - x0) / rise)
        total += weight * (crosses.sum(axis=1) % 2)
    return total
