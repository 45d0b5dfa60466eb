"""Closed contours of a picture by linear interpolation between the centres of pixels, and measures of them."""

from typing import Any

import numpy as np
from jaxtyping import Bool, Float64

Contour = Float64[np.ndarray, "_ 2"]


def level_contour(picture: Float64[np.ndarray, "height width"], level: float, around_px: Float64[np.ndarray, "2"]) -> Contour | None:
    """The closed contour at `level` that encloses a place and the most area; None where there is none."""
    from contourpy import contour_generator

    tracer: Any = contour_generator(z=picture)
    best, most = None, 0.0
    for line in tracer.lines(level):
        if len(line) < 8 or not np.array_equal(line[0], line[-1]):
            continue
        contour = line[:-1] + 0.5
        area = area_and_centroid(contour)[0]
        if area > most and _encloses(contour, around_px):
            best, most = contour, area
    return best


def _encloses(contour: Contour, place: Float64[np.ndarray, "2"]) -> bool:
    """The even-odd rule along a ray to the right."""
    start, stop = contour - place, np.roll(contour, -1, axis=0) - place
    crosses = (start[:, 1] > 0.0) != (stop[:, 1] > 0.0)
    start, stop = start[crosses], stop[crosses]
    at = start[:, 0] - start[:, 1] * (stop[:, 0] - start[:, 0]) / (stop[:, 1] - start[:, 1])
    return bool(int((at > 0.0).sum()) % 2)


def area_and_centroid(contour: Contour) -> tuple[float, Float64[np.ndarray, "2"]]:
    """By the shoelace formula."""
    following = np.roll(contour, -1, axis=0)
    cross = contour[:, 0] * following[:, 1] - following[:, 0] * contour[:, 1]
    total = float(cross.sum())
    if total == 0.0:
        return 0.0, contour.mean(axis=0)
    return 0.5 * abs(total), ((contour + following) * cross[:, None]).sum(axis=0) / (3.0 * total)


def even_points(contour: Contour, count: int) -> Contour:
    """`count` points at equal steps along a closed contour."""
    closed = np.concatenate([contour, contour[:1]])
    along = np.concatenate([[0.0], np.hypot(*np.diff(closed, axis=0).T).cumsum()])
    places = along[-1] * np.arange(count) / count
    return np.stack([np.interp(places, along, closed[:, i]) for i in (0, 1)], axis=1)


def inside(shape: tuple[int, ...], contour: Contour, inset_px: float) -> Bool[np.ndarray, "height width"]:
    """Pixels whose centres lie at least `inset_px` within a contour; negative: at most so far outside."""
    from shapely import Polygon, contains_xy, prepare

    area = Polygon(contour).buffer(-inset_px)
    prepare(area)
    rows, columns = np.indices(shape)
    return np.asarray(contains_xy(area, columns.ravel() + 0.5, rows.ravel() + 0.5)).reshape(shape)
