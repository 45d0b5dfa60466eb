"""Out-of-focus lights of a photograph: bright even plateaus with a sharp closed contour on darker surroundings.

They are looked for in compact parts above levels of light that step down. Contours are traced by linear interpolation between the centres
of pixels.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Bool, Float32, Float64

Contour = Float64[np.ndarray, "_ 2"]


def level_contour(picture: Float64[np.ndarray, "height width"], level: float, around_px: Float64[np.ndarray, "2"]) -> Contour | None:
    """Return the closed contour at `level` that encloses a place and the most area; None if there is none."""
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
    """Return whether a contour encloses a place, by the even-odd rule along a ray to the right."""
    start, stop = contour - place, np.roll(contour, -1, axis=0) - place
    crosses = (start[:, 1] > 0.0) != (stop[:, 1] > 0.0)
    start, stop = start[crosses], stop[crosses]
    at = start[:, 0] - start[:, 1] * (stop[:, 0] - start[:, 0]) / (stop[:, 1] - start[:, 1])
    return bool(int((at > 0.0).sum()) % 2)


def area_and_centroid(contour: Contour) -> tuple[float, Float64[np.ndarray, "2"]]:
    """Return area and centroid by the shoelace formula."""
    following = np.roll(contour, -1, axis=0)
    cross = contour[:, 0] * following[:, 1] - following[:, 0] * contour[:, 1]
    total = float(cross.sum())
    if total == 0.0:
        return 0.0, contour.mean(axis=0)
    return 0.5 * abs(total), ((contour + following) * cross[:, None]).sum(axis=0) / (3.0 * total)


def even_points(contour: Contour, count: int) -> Contour:
    """Return `count` points at equal steps along a closed contour."""
    closed = np.concatenate([contour, contour[:1]])
    along = np.concatenate([[0.0], np.hypot(*np.diff(closed, axis=0).T).cumsum()])
    places = along[-1] * np.arange(count) / count
    return np.stack([np.interp(places, along, closed[:, i]) for i in (0, 1)], axis=1)


def inside(shape: tuple[int, ...], contour: Contour, inset_px: float) -> Bool[np.ndarray, "height width"]:
    """Return the pixels whose centres lie at least `inset_px` within a contour; negative: at most so far outside."""
    from shapely import Polygon, contains_xy, prepare

    area = Polygon(contour).buffer(-inset_px)
    prepare(area)
    rows, columns = np.indices(shape)
    return np.asarray(contains_xy(area, columns.ravel() + 0.5, rows.ravel() + 0.5)).reshape(shape)


LARGEST_ASPECT = 2.6
_LARGEST_SHARE = 0.45  # of the shorter side of the frame
_LEVELS = 14
_BORDER_PX = 2

Box = tuple[int, int, int, int]


def bright_parts(grey: Float32[np.ndarray, "height width"], least_px: float) -> Iterator[Box]:
    """Yield boxes (left, top, width, height), clear of the border, from levels between the brightest light and near the median."""
    import cv2

    smooth = cv2.GaussianBlur(grey, (0, 0), 0.8)
    bright, dark = float(np.percentile(smooth, 99.97)), float(np.median(smooth))
    lowest = max(1.3 * dark, 2e-3 * bright, 1e-6)
    seen: set[Box] = set()
    for level in np.geomspace(0.9 * bright, lowest, _LEVELS) if bright > lowest else ():
        _, _, parts, _ = cv2.connectedComponentsWithStats((smooth > level).astype(np.uint8), connectivity=4)
        for left, top, wide, high, area in parts[1:].tolist():
            box = (left, top, wide, high)
            if box not in seen and area >= 0.5 * wide * high and _is_sized(box, grey.shape, least_px):
                seen.add(box)
                yield box


def _is_sized(box: Box, frame: tuple[int, ...], least_px: float) -> bool:
    left, top, wide, high = box
    height, width = frame
    clear = min(left, top) > _BORDER_PX and left + wide < width - _BORDER_PX and top + high < height - _BORDER_PX
    return (
        clear
        and min(wide, high) >= least_px
        and max(wide, high) <= min(_LARGEST_SHARE * min(height, width), LARGEST_ASPECT * min(wide, high))
    )


POINTS = 72
LEAST_DIAMETER_PX = 7.0
_LEAST_SOLIDITY, _LEAST_FILL = 0.85, 0.25
_LEAST_CONTRAST = 2.2  # of the plateau to its surroundings
_STEPS = (0.3, 0.5, 0.7)  # shares of the step at the edge, whose contours tell how sharp it is
_SOFTEST_EDGE_PX, _SOFTEST_EDGE = 1.3, 0.16  # difference of the outer two's radii: pixels, or a share of the radius
_UNEVENNESS = 0.3
_FULL, _FULL_SHARE = 0.98, 0.02
_FEWEST_PIXELS = 12
_APART = 0.8  # of the larger radius: nearer centres are of one light

Crop = Float64[np.ndarray, "height width"]


@dataclass(frozen=True)
class Disc:
    """Out-of-focus light.

    contour_px: points at equal steps along the contour. centroid_px, radius_px: of the disc of the same area. level, around:
    light inside (median) and outside. field_xy: place in half diagonals. full: whether its light is beyond what the file can hold.
    """

    contour_px: Contour
    centroid_px: Float64[np.ndarray, "2"]
    radius_px: float
    level: float
    around: float
    field_xy: tuple[float, float]
    full: bool


def find_discs(grey: Float32[np.ndarray, "height width"], largest_value: float = np.inf) -> list[Disc]:
    """Find discs apart from one another and from the border, the sharpest of those that lie at one place; brightest first.

    grey: linear light. largest_value: what the file can hold at most (1 for integers).
    """
    found: list[tuple[float, Disc]] = []
    for box in bright_parts(grey, 0.7 * LEAST_DIAMETER_PX):
        if not any(_is_of(box, disc) for _, disc in found) and (tried := _disc_in(grey, box, largest_value)) is not None:
            found.append(tried)
    kept: list[Disc] = []
    for _, disc in sorted(found, key=lambda each: each[0]):
        if all(np.hypot(*(disc.centroid_px - other.centroid_px)) > _APART * max(disc.radius_px, other.radius_px) for other in kept):
            kept.append(disc)
    return sorted(kept, key=lambda disc: -disc.level)


def _is_of(box: Box, disc: Disc) -> bool:
    """Return whether a part is that of a lower level around the same disc."""
    left, top, wide, high = box
    apart = float(np.hypot(left + 0.5 * wide - disc.centroid_px[0], top + 0.5 * high - disc.centroid_px[1]))
    return apart < 0.4 * disc.radius_px and max(wide, high) < 3.0 * disc.radius_px


def _disc_in(grey: Float32[np.ndarray, "height width"], box: Box, largest_value: float) -> tuple[float, Disc] | None:
    """Return (softness of its edge, the disc) of a box; None if there is none."""
    left, top, wide, high = box
    margin = 3 + max(wide, high) // 5
    corner = np.array([max(left - margin, 0), max(top - margin, 0)])
    crop = grey[corner[1] : top + high + margin, corner[0] : left + wide + margin].astype(np.float64)
    edge = _edge(crop, np.array([left + 0.5 * wide, top + 0.5 * high]) - corner, (wide, high))
    if edge is None:
        return None
    contours, around = edge
    areas = [area_and_centroid(contour)[0] for contour in contours]
    radii, centroid = np.sqrt(np.array(areas) / np.pi), area_and_centroid(contours[1])[1] + corner
    softness = float(radii[0] - radii[2])
    values = crop[inside(crop.shape, contours[1], 1.2)]
    sharp = softness <= max(_SOFTEST_EDGE_PX, _SOFTEST_EDGE * radii[1])
    if not sharp or 2.0 * radii[1] < LEAST_DIAMETER_PX or not _is_compact(contours[1], areas[1]) or values.size < _FEWEST_PIXELS:
        return None
    level = float(np.median(values))
    if level < _LEAST_CONTRAST * around or float(values.std()) > _UNEVENNESS * level:
        return None
    full = float((values >= _FULL * largest_value).mean()) > _FULL_SHARE
    contour = even_points(contours[1] + corner, POINTS)
    return softness / float(radii[1]), Disc(
        contour_px=contour,
        centroid_px=centroid,
        radius_px=float(radii[1]),
        level=level,
        around=around,
        field_xy=_field_xy(grey.shape, centroid),
        full=full,
    )


def _edge(crop: Crop, middle_px: Float64[np.ndarray, "2"], size_px: tuple[int, int]) -> tuple[Sequence[Contour], float] | None:
    """Return (the contours at `_STEPS` of the step from the surroundings to the light just inside the edge, the surroundings)."""
    rows, columns = np.indices(crop.shape) + 0.5
    quarter = (np.abs(rows - middle_px[1]) < 0.25 * size_px[1]) & (np.abs(columns - middle_px[0]) < 0.25 * size_px[0])
    first = level_contour(crop, 0.6 * float(np.median(crop[quarter])), middle_px) if quarter.any() else None
    if first is None:
        return None
    rim = inside(crop.shape, first, 0.9) & ~inside(crop.shape, first, 2.2)
    ring = inside(crop.shape, first, -4.0) & ~inside(crop.shape, first, -2.0)
    if not (rim.any() and ring.any()):
        return None
    light, around = float(np.median(crop[rim])), float(np.percentile(crop[ring], 80))
    found = [level_contour(crop, around + share * (light - around), middle_px) for share in _STEPS] if light > around else []
    contours = [contour for contour in found if contour is not None]
    return (contours, around) if len(contours) == len(_STEPS) else None


def _is_compact(contour: Contour, area: float) -> bool:
    import cv2

    points = contour.astype(np.float32)
    _, sides, _ = cv2.minAreaRect(points)
    solidity = area / max(float(cv2.contourArea(cv2.convexHull(points))), 1e-9)
    perimeter = float(np.hypot(*(np.roll(contour, -1, axis=0) - contour).T).sum())
    slim = max(sides) > LARGEST_ASPECT * min(sides)
    return solidity >= _LEAST_SOLIDITY and not slim and 4.0 * np.pi * area / perimeter**2 > _LEAST_FILL


def _field_xy(frame: tuple[int, ...], place_px: Float64[np.ndarray, "2"]) -> tuple[float, float]:
    height, width = frame
    half_diagonal = 0.5 * float(np.hypot(width, height))
    return float(place_px[0] - 0.5 * width) / half_diagonal, float(place_px[1] - 0.5 * height) / half_diagonal
