"""Background that a picture does not show: filled in behind the edges of what is near, or known from another view.

A pixel beside something nearer holds some of its colour (antialiasing), though its depth is one or the other: such edges
would stay behind as sharp ghosts of a blurred wire, and a lamp's as a bright dot. Mixed edges are split. The lens looks past
an edge by half the difference of the two circles of confusion; no farther is anything filled in. Highlights are no source
for it, or a single lamp beside an edge would shine twice. `layer_from_view` moves another view of the scene into this camera,
so that what lies behind the edges need not be guessed.
"""

from collections.abc import Callable
from concurrent.futures import Executor
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from jaxtyping import Bool, Float32, Int, Int32, Int64

from mrbokeh.images.layer import Layer
from mrbokeh.layering.highlights import find_highlights, mark_highlights
from mrbokeh.layering.padded_layers import PaddedLayer, Pixels
from mrbokeh.optics.camera import Camera
from mrbokeh.system.errors import InputError
from mrbokeh.system.resources import in_bands

_CLOSED_BY = 5
_SAME_DEPTH = 0.02
STEP_PX = 1.0  # less than this difference of circles of confusion between neighbours is one surface
SURFACE_PX = 2.0  # the same, for pixels some way apart
RIM_PX = 3
_DIRECTIONS = 8
_BAND_ROWS = 32
_BAND_PIXELS = 256
_OUTLINE_SIZES_PX = (4.0, 12.0, 40.0)
Values = Float32[np.ndarray, "height width channels"]
Plane = Float32[np.ndarray, "height width"]
Mask = Bool[np.ndarray, "height width"]
Places = Int32[np.ndarray, " _"]


@dataclass(frozen=True)
class _Edges:
    """Circles of confusion with none between two surfaces, pixels beside something nearer, pixels of one surface, and highlights."""

    coc_px: Float32[np.ndarray, "height width"]
    rims: Places
    pure: Mask
    lit: Mask


def split_edges(layer: PaddedLayer, pool: Executor) -> tuple[Pixels, Pixels]:
    """Return an opaque layer as what is in front, with soft edges, and what lies behind them. The front takes over the layer's memory."""
    edges = _edges(layer, pool)
    rims, places, seeds = _sources(edges)
    behind = _filled(layer.values, edges, places, seeds, pool)
    _unmix(layer.values, edges, rims, behind)
    return Pixels.of(PaddedLayer(layer.values, edges.coc_px, False)), behind


def hidden_within(layer: PaddedLayer, pool: Executor) -> list[Pixels]:
    """Return what a layer with holes hides behind its own near parts: nothing, or pixels behind the edges between two of its surfaces.

    Without it what is behind the layer shines through such edges. Only what is covered whole hides or is continued: outlines stay soft.
    """
    from mrbokeh.layering._hidden_background_numba import find_rims

    whole = layer.values[..., 3] >= 1.0
    if not whole.any():
        return []
    box = _box_of(whole)
    whole = whole[box]
    coc_px, rim = np.ascontiguousarray(continued(layer.coc_px[box], whole)), np.empty(whole.shape, np.bool_)
    in_bands(pool, len(rim), _BAND_ROWS, lambda top, bottom: find_rims(rim, coc_px, STEP_PX, top, bottom))
    rim &= whole
    if not rim.any():
        return []
    values = np.ascontiguousarray(layer.values[box])
    lit = find_highlights(values)
    edges = _Edges(coc_px, np.flatnonzero(rim).astype(np.int32), whole & ~(rim | lit), lit)
    _, places, seeds = _sources(edges)
    is_behind = whole.reshape(-1)[places] & (coc_px.reshape(-1)[seeds] > coc_px.reshape(-1)[places] + STEP_PX)
    filled = _filled(values, edges, places[is_behind], seeds[is_behind], pool)
    top, left = box[0].start, box[1].start
    rows, columns = np.divmod(filled.places, whole.shape[1])
    return [replace(filled, places=((rows + top) * layer.coc_px.shape[1] + columns + left).astype(np.int32))]


def enclosed_by(whole: Mask, coc_px: Plane, reach_px: Callable[[float], int]) -> Mask:
    """Return the pixels from which every ray ends on what is whole: those farther from its outline than the outline's own blur reaches.

    coc_px: signed diameters. reach_px: how far light of a diameter travels.
    """
    from cv2 import DIST_L2, DIST_MASK_5, distanceTransform, erode

    found = np.zeros_like(whole)
    box = _box_of(whole)
    inner = whole[box]
    beside = np.pad(inner, 1).astype(np.uint8)
    outline = inner & (erode(beside, np.ones((3, 3), np.uint8))[1:-1, 1:-1] == 0)
    sizes_px, enclosed = np.abs(coc_px[box]), inner.copy()
    bounds_px = [-1.0, *_OUTLINE_SIZES_PX, np.inf]
    for low_px, high_px in pairwise(bounds_px):
        of_size = outline & (sizes_px > low_px) & (sizes_px <= high_px)
        if of_size.any():
            reach = reach_px(float(sizes_px[of_size].max())) + 1
            enclosed &= distanceTransform((~of_size).astype(np.uint8), DIST_L2, DIST_MASK_5) > reach
    found[box] = enclosed
    return found


def _box_of(mask: Mask) -> tuple[slice, slice]:
    """Return rows and columns of the smallest box around what is there."""
    rows, columns = (np.flatnonzero(mask.any(axis=axis)) for axis in (1, 0))
    return slice(int(rows[0]), int(rows[-1]) + 1), slice(int(columns[0]), int(columns[-1]) + 1)


def _edges(layer: PaddedLayer, pool: Executor) -> _Edges:
    from mrbokeh.layering._hidden_background_numba import find_rims, snap

    coc_px, lit, rim = np.empty_like(layer.coc_px), np.empty(layer.coc_px.shape, np.bool_), np.empty(layer.coc_px.shape, np.bool_)

    def look(top: int, bottom: int) -> None:
        mark_highlights(lit, layer.values, top, bottom)
        snap(coc_px, layer.coc_px, lit, STEP_PX, top, bottom)

    in_bands(pool, len(rim), _BAND_ROWS, look)
    in_bands(pool, len(rim), _BAND_ROWS, lambda top, bottom: find_rims(rim, coc_px, STEP_PX, top, bottom))
    return _Edges(coc_px, np.flatnonzero(rim).astype(np.int32), ~(rim | lit), lit)


def _sources(edges: _Edges) -> tuple[Places, Places, Places]:
    """Return edge pixels beside pure ones, the places at which the lens sees behind an edge (edges included), and for each of these
    the nearest pure pixel of what it sees there.
    """
    from mrbokeh.layering._hidden_background_numba import Front, nearest_behind, pure_neighbours

    pure = pure_neighbours(edges.rims, edges.coc_px, edges.pure, STEP_PX, RIM_PX)
    front = Front.over(edges.coc_px.size)
    nearest_behind(front, edges.coc_px, edges.rims, pure, STEP_PX)
    seeds = front.seeds
    rims = edges.rims[pure >= 0]
    seeds[rims] = pure[pure >= 0] + 1
    places = np.flatnonzero(seeds != 0).astype(np.int32)
    return rims, places, seeds[places] - 1


def _filled(values: Values, edges: _Edges, places: Places, seeds: Places, pool: Executor) -> Pixels:
    """Return the background at these places, interpolated from the pixels around on the surface of each one's seed."""
    from mrbokeh.layering._hidden_background_numba import interpolate

    filled = Pixels(places, np.empty((len(places), values.shape[2]), np.float32), np.empty(len(places), np.float32))
    pure_coc_px = np.where(edges.pure, edges.coc_px, np.float32(np.nan))
    paths = _paths(places, seeds, values.shape[1])

    def fill(first: int, end: int) -> None:
        interpolate(filled.values, filled.coc_px, places, seeds, values, pure_coc_px, paths, SURFACE_PX, first, end)

    in_bands(pool, len(places), _BAND_PIXELS, fill)
    return filled


def _paths(places: Places, seeds: Places, width: int) -> Int32[np.ndarray, "8 _ 2"]:
    """Return rows down and columns to the right in 8 directions, at every distance that is looked at."""
    farthest_px = np.hypot(seeds // width - places // width, seeds % width - places % width).max(initial=0.0)
    angles_rad = np.arange(_DIRECTIONS) * (2.0 * np.pi / _DIRECTIONS)
    distances_px = np.arange(int(3.0 * farthest_px) + 6)
    steps = np.stack([np.sin(angles_rad), np.cos(angles_rad)], axis=1)
    return np.rint(distances_px[:, None] * steps[:, None]).astype(np.int32)


def _unmix(values: Values, edges: _Edges, rims: Places, behind: Pixels) -> None:
    """Split edge pixels in place: the front's share stays, the rest goes behind."""
    from mrbokeh.layering._hidden_background_numba import unmix_rims

    flat_values, flat_coc_px = values.reshape(-1, values.shape[2]), edges.coc_px.reshape(-1)
    front, front_coc_px = flat_values[rims], flat_coc_px[rims]
    of_behind = np.searchsorted(behind.places, rims)
    unmix_rims(front, front_coc_px, behind.values, rims, of_behind, values, edges.coc_px, edges.lit, STEP_PX)
    flat_values[rims], flat_coc_px[rims] = front, front_coc_px


def continued(values: np.ndarray, known: Mask) -> np.ndarray:
    """Values (H, W) or (H, W, C) of the nearest pixel where they are known; as they are where none is."""
    if known.all() or not known.any():
        return values
    return values.reshape(-1, *values.shape[2:])[nearest_places(known)]


def nearest_places(known: Mask) -> Int64[np.ndarray, "height width"]:
    """Per pixel the place (row times width plus column) of the nearest known one; some pixel must be known."""
    from cv2 import DIST_L2, DIST_LABEL_PIXEL, DIST_MASK_5, distanceTransformWithLabels

    _, labels = distanceTransformWithLabels((~known).astype(np.uint8), DIST_L2, DIST_MASK_5, labelType=DIST_LABEL_PIXEL)
    place_of = np.zeros(int(labels.max()) + 1, np.int64)
    places = np.flatnonzero(known)
    place_of[labels.reshape(-1)[places]] = places
    return place_of[labels]


def layer_from_view(
    rgb: Float32[np.ndarray, "height width 3"],
    depth_m: Float32[np.ndarray, "height width"],
    view: Camera,
    camera: Camera,
    shown_depth_m: Float32[np.ndarray, "rows columns"] | None = None,
) -> Layer:
    """Return the opaque picture (scene-linear) with its depth (metres; inf is left out) that `view` took, as a layer of `camera`.

    shown_depth_m: depth of the picture that `camera` took; then only what lies at least 2 % behind it is kept.
    Every pixel goes to the one pixel that its point falls on, and the nearest point wins; holes of single pixels, as
    enlarging leaves them, take the mean of neighbours at their depth. List it behind the picture of `camera`.
    """
    if depth_m.shape != (view.height_px, view.width_px):
        raise InputError(
            f"the other view has {depth_m.shape[::-1]} px, but its camera {view.width_px}x{view.height_px}: resize one of them"
        )
    usable = np.isfinite(depth_m) & (depth_m > 0)
    points_m = view.unproject(view.pixel_centres_px()[usable], depth_m[usable].astype(np.float64))
    xy_px, z_m = camera.project(points_m)
    column, row = (np.floor(xy_px[:, i]).astype(np.int64) for i in (0, 1))
    inside = (z_m > 0) & (column >= 0) & (column < camera.width_px) & (row >= 0) & (row < camera.height_px)
    if shown_depth_m is not None:
        inside[inside] = z_m[inside] > shown_depth_m[row[inside], column[inside]] * (1.0 + _SAME_DEPTH)
    colours = np.zeros((camera.height_px * camera.width_px, 3), np.float32)
    depths_m = np.full(len(colours), np.inf, np.float32)
    target, nearest = _nearest((row * camera.width_px + column)[inside], z_m[inside])
    colours[target], depths_m[target] = rgb[usable][inside][nearest], z_m[inside][nearest]
    size = camera.height_px, camera.width_px
    return _without_pinholes(colours.reshape(*size, 3), depths_m.reshape(size))


def _nearest(target: Int[np.ndarray, " points"], z_m: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return each target pixel once, and which of its points is the nearest."""
    order = np.lexsort((z_m, target))
    first = np.concatenate([[True], np.diff(target[order]) != 0])[: len(order)]
    return target[order][first], order[first]


def _without_pinholes(rgb: Float32[np.ndarray, "height width 3"], depth_m: Float32[np.ndarray, "height width"]) -> Layer:
    """Fill holes that have at least 5 of 8 neighbours about as deep as the nearest of them with the mean of these."""
    around = np.stack([np.roll(depth_m, (dy, dx), (0, 1)) for dy in (-1, 0, 1) for dx in (-1, 0, 1) if (dy, dx) != (0, 0)])
    colours = np.stack([np.roll(rgb, (dy, dx), (0, 1)) for dy in (-1, 0, 1) for dx in (-1, 0, 1) if (dy, dx) != (0, 0)])
    alike = around <= around.min(axis=0) * (1.0 + _SAME_DEPTH)
    alike &= np.isfinite(around)
    hole = np.isinf(depth_m) & (alike.sum(axis=0) >= _CLOSED_BY)
    count = np.maximum(alike.sum(axis=0), 1)
    depth_m = np.where(hole, np.where(alike, around, 0.0).sum(axis=0) / count, depth_m).astype(np.float32)
    rgb = np.where(hole[..., None], np.where(alike[..., None], colours, 0.0).sum(axis=0) / count[..., None], rgb).astype(np.float32)
    return Layer(rgb, np.isfinite(depth_m).astype(np.float32), depth_m)
