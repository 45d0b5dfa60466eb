"""Closed outlines as points (V, 2) in float64: their area, centre, superfluous vertices, and the corners of lines.

Areas are positive where x turns towards y.
"""

import numpy as np
from jaxtyping import Float64

EXACT = 1e-9
"""Half extents below which two points are one, and sines below which an edge has a direction."""

Outline = Float64[np.ndarray, "_ 2"]


def area(outline: Outline) -> float:
    """Signed area: positive where x turns towards y."""
    x, y = (outline - outline[0]).T
    return 0.5 * float(np.dot(x, np.roll(y, -1)) - np.dot(np.roll(x, -1), y))


def centroid(outline: Outline) -> Float64[np.ndarray, "2"]:
    """The centre of the enclosed area."""
    points = outline - outline[0]
    following = np.roll(points, -1, axis=0)
    swept = points[:, 0] * following[:, 1] - following[:, 0] * points[:, 1]
    return outline[0] + (swept[:, None] * (points + following)).sum(axis=0) / (3.0 * swept.sum())


def without_flat_vertices(outline: Outline) -> Outline:
    """The outline without repeated vertices and those within rounding of the line between their neighbours."""
    extent = np.ptp(outline, axis=0).max()
    for _ in range(2):
        outline = outline[np.hypot(*(outline - np.roll(outline, 1, axis=0)).T) > EXACT * extent]
        step, onwards = outline - np.roll(outline, 1, axis=0), np.roll(outline, -1, axis=0) - outline
        aside = np.abs(step[:, 0] * onwards[:, 1] - step[:, 1] * onwards[:, 0])
        flat = (aside <= 1e-12 * extent * np.hypot(*(step + onwards).T)) & ((step * onwards).sum(axis=1) > 0.0)
        outline = outline[~flat]
    return outline


def corner_points(lines: np.ndarray, outwards: float) -> Outline:
    """The polygon of lines (x, y, dx, dy) in their order, all moved `outwards`, to the right of their directions."""
    points, along = lines[:, :2] + outwards * lines[:, 3:1:-1] * [1.0, -1.0], lines[:, 2:4]
    offset, following = np.roll(points, -1, axis=0) - points, np.roll(along, -1, axis=0)
    ahead = _cross(offset, following) / _cross(along, following)
    return points + ahead[:, None] * along


def _cross(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]


def swept_areas(outline: Outline) -> np.ndarray:
    """(V + 1,) twice the area swept from the origin along the outline up to each vertex, and once around."""
    return np.concatenate([[0.0], np.cumsum(_cross(outline, np.roll(outline, -1, axis=0)))])
