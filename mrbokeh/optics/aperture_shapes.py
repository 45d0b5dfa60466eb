"""Outlines of openings: regular polygons, curved blades, stars, hearts, shapes traced from pictures and SVG paths, and what clips them.

All lie in the unit pupil, x right, y down, as the blur of a far light shows them in an upright picture. Shapes without a
centre of their own (hearts, pictures, paths) are `settled`: the centroid of their light, that is of their weighted area,
lies at the origin and their farthest point at radius 1, so that a blurred point stays in place.

Modifiers (a rim that clips, weights over the pupil) work on weighted polygons; an outline that a modifier leaves untouched comes back
as the very same array. Boolean operations are Shapely's.
"""

import math
from collections.abc import Sequence
from itertools import pairwise
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Float, Float64

from mrbokeh.system.errors import InputError

if TYPE_CHECKING:
    from shapely import Geometry

Outline = Float64[np.ndarray, "_ 2"]
WeightedOutlines = tuple[tuple[Outline, ...], tuple[float, ...]]

CIRCLE_SIDES = 64
HEART_SIDES = 96
_SPECK = 1e-9  # area, where the unit disc has pi
_TRACING_TOLERANCE_PX = 0.1
_CURVE_TOLERANCE = 5e-4  # of the extent of an SVG path


def regular_polygon(sides: int, rotation_rad: float = 0.0) -> Float64[np.ndarray, "sides 2"]:
    """Return corners on the unit circle, the first one on the x axis turned by `rotation_rad` (from x to y)."""
    angles_rad = rotation_rad + 2.0 * np.pi * np.arange(sides) / sides
    return np.stack([np.cos(angles_rad), np.sin(angles_rad)], axis=1)


def unit_disc(sides: int = CIRCLE_SIDES) -> Float64[np.ndarray, "sides 2"]:
    """Return the regular polygon that has the area of the unit disc, so that it passes the same light."""
    return regular_polygon(sides) * np.sqrt(2.0 * np.pi / (sides * np.sin(2.0 * np.pi / sides)))


MOST_BLADES = 100


def blades(count: int, rotation_rad: float = 0.0, curvature: float = 0.0) -> Float64[np.ndarray, "vertices 2"]:
    """Return an iris; see `mrbokeh.optics.aperture.Aperture.blades`."""
    if not 3 <= count <= MOST_BLADES:
        raise InputError(f"an iris has 3 to {MOST_BLADES} blades, got {count}")
    corners = regular_polygon(count, rotation_rad)
    return corners if curvature == 0.0 else _with_arcs(corners, curvature)


def _with_arcs(corners: Float64[np.ndarray, "corners 2"], curvature: float) -> Float64[np.ndarray, "vertices 2"]:
    """Return arcs of radius 1 / |curvature| from corner to corner of a regular polygon, at 1 as finely cut as a disc is."""
    half_angle_rad = np.pi / len(corners)
    bow_rad = np.arcsin(np.clip(curvature, -1.0, 1.0) * np.sin(half_angle_rad))
    if not abs(curvature) <= 1.0 or -bow_rad > 0.5 * np.pi - half_angle_rad + 1e-9:
        raise InputError(
            f"the curvature of {len(corners)} blades must lie between 0 (straight) and 1 (round), or down to "
            f"{max(-1.0, -1.0 / np.tan(half_angle_rad)):.3g} for blades that bulge inwards, got {curvature}"
        )
    pieces = max(1, int(np.ceil(abs(bow_rad) * CIRCLE_SIDES / np.pi / np.sqrt(abs(curvature)))))
    # In the frame of one side: along its chord from corner to corner, and outwards.
    turns_rad = np.linspace(-bow_rad, bow_rad, pieces + 1)[:-1]
    along = (np.sin(turns_rad) / np.sin(bow_rad) + 1.0) / 2.0
    outwards = (np.cos(turns_rad) - np.cos(bow_rad)) / curvature
    following = np.roll(corners, -1, axis=0)
    normals = (corners + following) / (2.0 * np.cos(half_angle_rad))
    points = corners[:, None] + along[:, None] * (following - corners)[:, None] + outwards[:, None] * normals[:, None]
    return np.concatenate(points)


def star(points: int, inner: float, rotation_rad: float = 0.0) -> Float64[np.ndarray, "vertices 2"]:
    """Return a star: tips on the unit circle, the first one upwards (turned by `rotation_rad` from x to y), notches at radius `inner`."""
    if points < 3 or not 0.0 < inner <= 1.0:
        raise InputError(f"a star needs at least 3 points and an inner radius above 0 and up to 1, got {points} and {inner}")
    corners = regular_polygon(2 * points, rotation_rad - 0.5 * np.pi)
    corners[1::2] *= inner
    return corners


def heart() -> Outline:
    """Return x = 16 sin^3 t, y = 13 cos t - 5 cos 2t - 2 cos 3t - cos 4t (area 180 pi), tip down, settled."""
    t = 2.0 * np.pi * np.arange(HEART_SIDES) / HEART_SIDES
    up = 13.0 * np.cos(t) - 5.0 * np.cos(2.0 * t) - 2.0 * np.cos(3.0 * t) - np.cos(4.0 * t)
    return settled(((np.stack([16.0 * np.sin(t) ** 3, -up], axis=1),), (1.0,)))[0][0]


def from_picture(transmission: Float[np.ndarray, "height width"], levels: int = 1) -> WeightedOutlines:
    """Trace outlines of the light parts of a picture, settled; holes have negative weights.

    transmission: (H, W), any scale; the largest value passes all light, 0 none, and nothing passes beyond the picture.
    levels: 1 traces the contour at half of the largest value; n stacks n contours at (k - 1/2) / n, each of weight 1 / n,
    which renders grey as grey in n steps. Contours are traced by linear interpolation between the centres of pixels and
    thinned to within a tenth of a pixel.
    """
    from contourpy import FillType, contour_generator
    from shapely import MultiPolygon, Polygon, make_valid

    brightest = float(np.max(transmission, initial=0.0))
    if levels < 1 or not np.isfinite(transmission).all() or transmission.min() < 0.0 or brightest <= 0.0:
        raise InputError("an opening is traced from a picture with values from 0 (closed) up to more than 0 (open), in 1 or more levels")
    tracer: Any = contour_generator(z=np.pad(transmission.astype(np.float64) / brightest, 1), fill_type=FillType.OuterOffset)
    outlines: list[Outline] = []
    weights: list[float] = []
    for level in range(levels):
        areas = []
        for points, starts in zip(*tracer.filled((level + 0.5) / levels, 2.0), strict=True):
            rings = [points[start:stop] for start, stop in pairwise(starts)]
            areas.append(Polygon(rings[0], rings[1:]))
        shape = make_valid(MultiPolygon(areas)).simplify(_TRACING_TOLERANCE_PX)
        found = outlines_of(shape, 1.0 / levels)
        outlines.extend(found[0])
        weights.extend(found[1])
    return settled((tuple(outlines), tuple(weights)))


def from_points(points: Sequence[Sequence[float]] | Outline) -> WeightedOutlines:
    """Return a closed outline from its corners, in any unit, settled; if it crosses itself the even-odd rule holds."""
    corners = np.asarray(points, np.float64)
    if corners.ndim != 2 or corners.shape[1] != 2 or len(corners) < 3 or not np.isfinite(corners).all():
        raise InputError(f"an outline is a list of at least 3 points [x, y], got an array of shape {corners.shape}")
    return _even_odd([corners])


def from_svg_path(path: str) -> WeightedOutlines:
    """Return the area of an SVG path (its `d` attribute, all commands, y down), settled; overlapping parts follow the even-odd rule."""
    from fontTools.pens.recordingPen import RecordingPen
    from fontTools.svgLib.path import parse_path

    pen = RecordingPen()
    try:
        parse_path(path, pen)
    except Exception as error:  # its parser raises whatever a malformed number or command leads to
        raise InputError(f"expected the d attribute of an SVG path such as 'M0 0 L1 0 L1 1 Z', got {path[:60]!r} ({error!r})") from None
    places = np.array([point for _, points in pen.value for point in points], np.float64).reshape(-1, 2)
    tolerance = _CURVE_TOLERANCE * float(np.ptp(places, axis=0).max()) if len(places) else 1.0
    subpaths: list[list[np.ndarray]] = []
    for command, points in pen.value:
        if command == "moveTo":
            subpaths.append([np.asarray(points[0], np.float64)])
        elif command in ("lineTo", "curveTo", "qCurveTo"):
            subpaths[-1].extend(_bezier_points(np.array([subpaths[-1][-1], *points], np.float64), tolerance))
    return _even_odd([np.array(subpath) for subpath in subpaths if len(subpath) > 2])


def _bezier_points(controls: Float64[np.ndarray, "controls 2"], tolerance: float) -> Float64[np.ndarray, "points 2"]:
    """Return points on a straight, quadratic or cubic Bezier curve after its start, so dense that chords stay within `tolerance`.

    A chord over 1/n of the parameter strays by at most max|B''| / (8 n^2), and |B''| by degree (degree - 1) times the
    largest second difference of the control points.
    """
    from scipy.special import comb

    degree = len(controls) - 1
    bend = float(np.abs(np.diff(controls, 2, axis=0)).max(initial=0.0)) * degree * (degree - 1)
    count = max(1, int(np.ceil(np.sqrt(bend / (8.0 * tolerance))))) if tolerance > 0.0 else 1
    t = np.arange(1, count + 1)[:, None] / count
    k = np.arange(degree + 1)
    return (comb(degree, k) * t**k * (1.0 - t) ** (degree - k)) @ controls


def _even_odd(rings: Sequence[Outline]) -> WeightedOutlines:
    from shapely import Polygon, make_valid

    shape: Geometry = Polygon()
    for ring in rings:
        shape = shape.symmetric_difference(make_valid(Polygon(ring)))
    return settled(outlines_of(shape))


def settled(opening: WeightedOutlines) -> WeightedOutlines:
    """Move and scale an opening so that the centroid of light is the origin and the farthest point lies at radius 1."""
    if not opening[0] or not net_area(opening) > 0.0:
        raise InputError("expected an outline that encloses an area, but this one encloses none")
    middle = centroid(opening)
    largest = max(float(np.hypot(*(outline - middle).T).max()) for outline in opening[0])
    return tuple((outline - middle) / largest for outline in opening[0]), opening[1]


def outlines_of(geometry: "Geometry", weight: float = 1.0) -> WeightedOutlines:
    """Return the polygons of a Shapely geometry: outer rings with `weight`, holes with its negative; lines and specks are left out."""
    from shapely import Polygon, get_parts

    outlines: list[Outline] = []
    weights: list[float] = []
    for part in get_parts(get_parts(geometry)):
        if part.geom_type != "Polygon" or part.area <= _SPECK:
            continue
        rings = [part.exterior, *(hole for hole in part.interiors if Polygon(hole).area > _SPECK)]
        outlines.extend(np.array(ring.coords)[:-1, :2] for ring in rings)
        weights.extend([weight] + [-weight] * (len(rings) - 1))
    return tuple(outlines), tuple(weights)


def net_area(opening: WeightedOutlines) -> float:
    """Return the weighted sum of areas: the light that passes, where the unit disc passes pi."""
    return sum(weight * area(outline) for outline, weight in zip(*opening, strict=True))


def area(outline: Outline) -> float:
    """Return the area by the shoelace formula; the winding direction does not matter."""
    x, y = outline.T
    return 0.5 * abs(float(np.sum(x * np.roll(y, -1) - np.roll(x, -1) * y)))


def centroid(opening: WeightedOutlines) -> Float64[np.ndarray, "2"]:
    """Return the centroid of light: of the weighted area, not of the vertices."""
    moment = np.zeros(2)
    for outline, weight in zip(*opening, strict=True):
        following = np.roll(outline, -1, axis=0)
        cross = outline[:, 0] * following[:, 1] - following[:, 0] * outline[:, 1]
        moment += weight * np.copysign(1.0, cross.sum()) * ((outline + following) * cross[:, None]).sum(axis=0) / 6.0
    return moment / net_area(opening)


_ABERRATION_STEP = 1.0 / 8.0
_FEWEST_ZONES = 4
_RIM_TOLERANCE = 1e-3


def clipped(outline: Outline, clip: Outline, weight: float = 1.0) -> WeightedOutlines:
    """Return the parts of an outline within the convex outline `clip`, each with `weight`."""
    from shapely import Polygon

    whole, window = Polygon(outline), Polygon(clip)
    if window.covers(whole):
        return (outline,), (weight,)
    if whole.covers(window):
        return (clip,), (weight,)
    return outlines_of(whole.intersection(window), weight)


def clipped_by_rim(opening: WeightedOutlines, centre_xy: tuple[float, float], radius: float = 1.0) -> WeightedOutlines:
    """Return the part of the opening that is seen through a round rim about `centre_xy`: a cat-eye.

    Outlines that reach beyond the rim by less than its own polygon strays from a circle are left as they are.
    """
    centre = np.asarray(centre_xy)
    parts: list[WeightedOutlines] = []
    for outline, weight in zip(*opening, strict=True):
        untouched = float(np.hypot(*(outline - centre).T).max()) <= radius + _RIM_TOLERANCE
        parts.append(((outline,), (weight,)) if untouched else clipped(outline, radius * unit_disc() + centre, weight))
    return joined(parts)


def closed(outline: Float64[np.ndarray, "vertices 2"]) -> Float64[np.ndarray, "points 2"]:
    """Return an outline that ends where it began, as lines are drawn."""
    return np.concatenate([outline, outline[:1]])


def joined(parts: list[WeightedOutlines]) -> WeightedOutlines:
    return tuple(outline for part in parts for outline in part[0]), tuple(weight for part in parts for weight in part[1])


def radially_weighted(opening: WeightedOutlines, strength: float) -> WeightedOutlines:
    """Weight light by 1 + strength (2 rho^2 - 1), rho the distance from the centre of the pupil: spherical aberration.

    strength: -1 (rim dark) to 1 (centre dark). The mean over the unit disc is 1, whatever the strength. The weight is
    constant within concentric zones of equal area and equals the formula in the middle of each (in rho^2); there are as
    many zones as keep a step within 1/8 of the mean, and no weight is negative. Written as a sum: the whole opening with
    the outermost zone's weight, corrected on the smaller and smaller discs inside it.
    """
    zones = max(_FEWEST_ZONES, math.ceil(2.0 * abs(strength) / _ABERRATION_STEP))
    parts: list[WeightedOutlines] = []
    for outline, weight in zip(*opening, strict=True):
        parts.append(((outline,), (weight * (1.0 + strength * (1.0 - 1.0 / zones)),)))
        discs = (math.sqrt(zone / zones) * unit_disc() for zone in range(1, zones))
        parts.extend(clipped(outline, disc, -weight * 2.0 * strength / zones) for disc in discs)
    return _without_repeats(joined(parts))


def _without_repeats(opening: WeightedOutlines) -> WeightedOutlines:
    """Merge equal outlines and add their weights; the discs inside the hole of a ring cancel."""
    total: dict[bytes, tuple[Outline, float]] = {}
    for outline, weight in zip(*opening, strict=True):
        before = total.get(outline.tobytes(), (outline, 0.0))[1]
        total[outline.tobytes()] = (outline, before + weight)
    kept = [(outline, weight) for outline, weight in total.values() if abs(weight) > 1e-12]
    return tuple(outline for outline, _ in kept), tuple(weight for _, weight in kept)


def shifted(opening: WeightedOutlines, by_xy: tuple[float, float]) -> WeightedOutlines:
    return tuple(outline + np.asarray(by_xy) for outline in opening[0]), opening[1]
