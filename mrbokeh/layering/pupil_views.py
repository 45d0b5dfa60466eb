"""Corrections at rims, where slices do not know which part of the pupil is taken.

Layers that lie over one another are blurred by themselves, then the front hides as much of what is behind as it covers. That is right
only where both take parts of the pupil that have nothing to do with each other: beside a rim in front the free part of the pupil may see
just the bright side of an edge behind. How far they go together (their covariance) is found by looking at the layers from points spread
evenly over the pupil: one pinhole picture from each, in which every pixel moves by its share of its circle of confusion and the nearest
wins. Only this difference is taken from so few points, as much of it as chance does not explain; coverage and light come from the
renderer. A pixel that covers a share is there for that share of the points.

Lights are too bright for that. Those whose blur reaches a rim are taken out before, spread by their own kernels, and at each pixel of its
blur one sees along single rays whether something nearer is in the way: a lamp behind a twig is cut by it as by a knife.
"""

from collections.abc import Iterable, Iterator, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from jaxtyping import Bool, Float32, Int32, Int64

from mrbokeh.layering.highlights import LIGHT_OVER_SURROUNDINGS
from mrbokeh.layering.padded_layers import PaddedLayer, Pixels
from mrbokeh.layering.psf_over_field import FIELD_CELLS, Frame, field_cells_of, opening_of_cell
from mrbokeh.optics.aperture import Aperture
from mrbokeh.optics.pupil_points import pupil_points, transmission
from mrbokeh.system.resources import in_bands

if TYPE_CHECKING:
    from mrbokeh.layering._pupil_views_numba import Window

_LEAST_VIEWS, _MOST_VIEWS, _PX_PER_VIEW = 24, 96, 6.0
_TILE_PX, _BLOCK_ROWS, _BLOCK_COLUMNS = 16, 96, 192
_BESIDE_PX = 2
_NOISE = 0.8
_SIZES_PER_PX, _STEPS = 64, 512.0
_FAINT = 0.02
_BAND_ROWS = 64
_GOLDEN = np.float32(0.5 * (5.0**0.5 - 1.0))

Mask = Bool[np.ndarray, "_ _"]
Places = Int32[np.ndarray, " places"]
Sizes = Float32[np.ndarray, " places"]
Colour = Float32[np.ndarray, "height width channels"]


class Cut(NamedTuple):
    """Layers that are blurred together, with their margin, and the surfaces that they were cut into.

    An opaque layer comes first; its own surfaces are the front, then what lies behind its rims (where other layers are known), and last
    what is filled in. lights: which pixels of each layer are far brighter than those around them, before it was cut.
    """

    layers: Sequence[PaddedLayer]
    surfaces: Sequence[Pixels]
    lights: Sequence[Mask]

    @property
    def is_opaque(self) -> bool:
        return self.layers[0].is_opaque

    @property
    def pairs(self) -> list[tuple[PaddedLayer, Pixels, Mask]]:
        """Each layer with a pixel at every place, an opaque one as its front is, then its surface and its lights."""
        first, front = self.layers[0], self.surfaces[0]
        if not self.is_opaque:
            return list(zip(self.layers, self.surfaces[: len(self.layers)], self.lights, strict=True))
        split = PaddedLayer(front.values.reshape(first.values.shape), front.coc_px.reshape(first.coc_px.shape), True)
        behind = zip(self.layers[1:], self.surfaces[2:-1], self.lights[1:], strict=True)
        return [(split, front, self.lights[0]), *behind]

    @property
    def hidden(self) -> list[Pixels]:
        """Surfaces behind the rims of an opaque layer."""
        last = [self.surfaces[-1]] if len(self.surfaces) > 2 else []
        return [self.surfaces[1], *last] if self.is_opaque else []


@dataclass(frozen=True)
class Rims:
    """Rims of a scene without holes as the pupil sees them.

    tiles: marked where light from beside or behind a rim may arrive; layer_tiles: the same for borders of layers alone. frame: placement
    of arrays with their margin.
    """

    cuts: Sequence[Cut]
    aperture: Aperture
    frame: Frame
    tiles: Mask
    layer_tiles: Mask

    @classmethod
    def of(cls, cuts: Sequence[Cut], aperture: Aperture, frame: Frame) -> "Rims":
        of_layers = _tiles(_rims_of_layers(cuts), aperture, frame)
        return cls(cuts, aperture, frame, of_layers | _tiles(_rims_of_picture(cuts), aperture, frame), of_layers)

    def take_lights(self) -> "list[_Lights]":
        """Take lights whose blur reaches a rim out of the surfaces, which keep what is around them in their place."""
        found = []
        for surface, of_surface, dark in self._darkened():
            rgb, coc_px = surface.values[of_surface, :3] - dark, surface.coc_px[of_surface]
            kept = self._shows(rgb, coc_px)
            surface.values[of_surface[kept], :3] = dark[kept]
            found.append(_Lights(surface.places[of_surface[kept]].astype(np.int64), rgb[kept], coc_px[kept]))
        return found

    def _darkened(self) -> "Iterator[tuple[Pixels, Int64[np.ndarray, ' lights'], Float32[np.ndarray, 'lights 3']]]":
        """Yield surfaces, which of their pixels are lights whose blur reaches a rim, and what these would be without their light."""
        from mrbokeh.layering._pupil_views_numba import darken

        for layer, surface, lit in (pair for cut in self.cuts for pair in cut.pairs):
            width, places = layer.coc_px.shape[1], np.flatnonzero(lit)
            places = places[self._reach_rims(places, layer.coc_px.reshape(-1)[places], width)]
            if len(places) == 0 or len(surface.places) == 0:
                continue
            at = np.minimum(np.searchsorted(surface.places, places), len(surface.places) - 1)
            there = surface.places[at] == places
            places, dark = places[there], np.empty((int(there.sum()), 3), np.float32)
            flat = layer.values.reshape(-1, layer.values.shape[2])
            darken(dark, places, flat, lit.reshape(-1), width, float(LIGHT_OVER_SURROUNDINGS))
            yield surface, at[there], dark

    def _shows(self, rgb: Float32[np.ndarray, "lights 3"], coc_px: Sizes) -> Bool[np.ndarray, " lights"]:
        """Return which lights can be seen once they are spread: brighter, where they arrive, than a small share of the picture's light."""
        spread = rgb.max(axis=1, initial=0.0) / np.maximum(0.25 * np.pi * coc_px**2, 1.0)
        return spread > _FAINT * sum(float(layer.values[..., :3].mean()) for cut in self.cuts for layer in cut.layers)

    def _reach_rims(self, places: Int64[np.ndarray, " lights"], coc_px: Sizes, width: int) -> Bool[np.ndarray, " lights"]:
        from cv2 import integral

        counts = integral(self.tiles.astype(np.uint8))
        reach = np.ceil(0.5 * self.aperture.unit_radius * np.abs(coc_px)).astype(np.int64) + 1
        row, column = places // width + self.frame.top_px, places % width + self.frame.left_px
        rows, columns = self.tiles.shape
        top, bottom = (np.clip(each // _TILE_PX, 0, rows) for each in (row - reach, row + reach + _TILE_PX))
        left, right = (np.clip(each // _TILE_PX, 0, columns) for each in (column - reach, column + reach + _TILE_PX))
        return counts[bottom, right] - counts[top, right] - counts[bottom, left] + counts[top, left] > 0

    def put_lights(self, colour: Colour, lights: "Sequence[_Lights]", pool: Executor) -> None:
        """Add lights where they arrive past all that is nearer."""
        from mrbokeh.layering._pupil_views_numba import Occluders, add_cut_lights

        if not any(len(each.places) for each in lights):
            return
        layers = [layer for cut in self.cuts for layer, _, _ in cut.pairs]
        coc_px, alpha = np.stack([each.coc_px for each in layers]), np.stack([each.values[..., 3] for each in layers])
        before, radius = Occluders(coc_px=coc_px, alpha=alpha, nearest_px=float(coc_px.min())), self.aperture.unit_radius
        for each in lights:
            for which, kernel in _kernels(each.places, each.coc_px, self.aperture, self.frame):
                lit = each.places[which], each.rgb[which], each.coc_px[which], kernel, radius, before
                work = lambda first, end: add_cut_lights(colour, (first, end), -self.frame.left_px, *lit)  # noqa: B023, E731
                in_bands(pool, len(colour), _BAND_ROWS, work)

    def correct(self, colour: Colour, pool: Executor) -> None:
        """Take back, where cuts were laid over one another, how far light and what hides it go together over the pupil."""
        if len(self.cuts) == 1:
            return
        for surface, of_surface, dark in self._darkened():  # a single point that meets a light tells nothing
            surface.values[of_surface, :3] = dark
        surfaces = [(each, group) for group, cut in enumerate(self.cuts) for each in cut.surfaces if len(each.places)]
        groups = np.array([group for _, group in surfaces])
        views = _Views([each for each, _ in surfaces], groups, self.aperture, self.frame)
        list(pool.map(lambda block: views.correct(colour, self.layer_tiles, block), _blocks(self.layer_tiles, self.frame)))


@dataclass(frozen=True)
class _Lights:
    """Lights: places in the frame with its margin, light beyond what is around them, circles of confusion."""

    places: Int64[np.ndarray, " lights"]
    rgb: Float32[np.ndarray, "lights 3"]
    coc_px: Float32[np.ndarray, " lights"]


def _tiles(rims: Iterable[tuple[Places, Sizes]], aperture: Aperture, frame: Frame) -> Mask:
    """Mark the tiles of the picture that light from beside or behind a rim may reach."""
    from mrbokeh.layering._pupil_views_numba import mark_reach

    tiles = np.zeros((-(-frame.height_px // _TILE_PX), -(-frame.width_px // _TILE_PX)), np.bool_)
    for places, coc_px in rims:
        reach_px = np.ceil(0.5 * aperture.unit_radius * coc_px).astype(np.int32) + _BESIDE_PX
        mark_reach(tiles, _TILE_PX, frame.width_px - 2 * frame.left_px, -frame.left_px, places, reach_px)
    return tiles


def _rims_of_picture(cuts: Sequence[Cut]) -> Iterator[tuple[Places, Sizes]]:
    """Yield places at which a picture hides itself, and the larger circle of confusion of both surfaces (without sign)."""
    for cut in cuts:
        for behind in cut.hidden:
            yield behind.places, np.maximum(np.abs(behind.coc_px), np.abs(cut.surfaces[0].coc_px[behind.places]))


def _rims_of_layers(cuts: Sequence[Cut]) -> Iterator[tuple[Places, Sizes]]:
    """Yield places at the borders of layers with holes, and the larger circle of confusion of the layer and the picture."""
    from cv2 import erode

    opaque_px = next(cut.surfaces[0].coc_px for cut in cuts if cut.is_opaque)
    for layer in (layer for cut in cuts for layer in cut.layers if not layer.is_opaque):
        covered = (layer.values[..., 3] > 0).astype(np.uint8)
        places = np.flatnonzero((covered > 0) & (np.asarray(erode(covered, np.ones((3, 3), np.uint8))) == 0)).astype(np.int32)
        yield places, np.maximum(np.abs(layer.coc_px.reshape(-1)[places]), np.abs(opaque_px[places]))


def _blocks(tiles: Mask, frame: Frame) -> Iterator[tuple[int, int, int, int]]:
    """Yield top, bottom, left and right of what is marked in each block of the picture."""
    rows, columns = _BLOCK_ROWS // _TILE_PX, _BLOCK_COLUMNS // _TILE_PX
    for top in range(0, tiles.shape[0], rows):
        for left in range(0, tiles.shape[1], columns):
            y, x = np.nonzero(tiles[top : top + rows, left : left + columns])
            if len(y):
                corners = (top + y.min(), top + y.max() + 1, left + x.min(), left + x.max() + 1)
                first, end, begin, stop = (int(each) * _TILE_PX for each in corners)
                yield first, min(end, frame.height_px), begin, min(stop, frame.width_px)


def _kernels(
    places: Int64[np.ndarray, " lights"], coc_px: Float32[np.ndarray, " lights"], aperture: Aperture, frame: Frame
) -> Iterator[tuple[Int64[np.ndarray, " _"], np.ndarray]]:
    """Yield indices of lights that are spread alike, and their kernel."""
    steps_px = np.exp2(np.ceil(np.log2(np.maximum(np.abs(coc_px) / _STEPS, 1.0 / _SIZES_PER_PX))))
    sizes = np.rint(np.rint(coc_px / steps_px) * steps_px * _SIZES_PER_PX).astype(np.int64)
    width = frame.width_px - 2 * frame.left_px
    cells = field_cells_of(places // width + frame.top_px, places % width + frame.left_px, aperture, frame)
    for cell, size in np.unique(np.stack([cells, sizes], axis=1), axis=0) if len(places) else ():
        opening = opening_of_cell(aperture, int(cell), frame)
        yield np.flatnonzero((cells == cell) & (sizes == size)), opening.rasterize(float(size) / _SIZES_PER_PX).kernel


@dataclass(frozen=True)
class _Views:
    """Pinhole pictures of surfaces from points of the pupil, block by block of the picture."""

    surfaces: Sequence[Pixels]
    groups: Int64[np.ndarray, " surfaces"]
    aperture: Aperture
    frame: Frame

    @cached_property
    def _pupil(self) -> Float32[np.ndarray, "points 3"]:
        """x, y and the coverage from which on a pixel is there for a point: evenly spread for any group of points."""
        count = int(np.clip((2.0 * self._reach_px) ** 2 / _PX_PER_VIEW, _LEAST_VIEWS, _MOST_VIEWS))
        points = pupil_points(self.aperture.seen(1), count).astype(np.float32)
        points[:, 2] = (np.arange(1, count + 1, dtype=np.float32) * _GOLDEN) % 1.0
        return points

    @cached_property
    def _weights(self) -> Float32[np.ndarray, "cells points"]:
        xy = self._pupil[:, :2].astype(np.float64)
        cells = FIELD_CELLS[0] * FIELD_CELLS[1] if self.aperture.varies_over_field else 1
        return np.stack([transmission(opening_of_cell(self.aperture, cell, self.frame), xy) for cell in range(cells)]).astype(np.float32)

    @cached_property
    def _reach_px(self) -> int:
        return int(np.ceil(0.5 * self.aperture.unit_radius * max(float(np.abs(each.coc_px).max()) for each in self.surfaces))) + _BESIDE_PX

    def correct(self, colour: Colour, tiles: Mask, block: tuple[int, int, int, int]) -> None:
        """Correct what is marked of a block."""
        from mrbokeh.layering._pupil_views_numba import correlate, take_back

        top, bottom, left, right = block
        grown = top - 1, bottom + 1, left - 1, right + 1  # cracks are closed between neighbours
        rows, columns = np.arange(*grown[:2]), np.arange(*grown[2:])
        rows, columns = rows.clip(0, self.frame.height_px - 1), columns.clip(0, self.frame.width_px - 1)
        cells = field_cells_of(rows[:, None], columns[None], self.aperture, self.frame)
        count, shape = int(self.groups[-1]) + 1, (len(rows), len(columns))
        sums = np.zeros((*shape, count - 1, 9), np.float32)
        nearest, which = np.empty((count, *shape), np.float32), np.empty((count, *shape), np.int32)
        correlate(sums, self._window(grown), self.groups, self._pupil, cells, self._weights, nearest, which)
        take_back(colour, sums[1:-1, 1:-1], tiles, _TILE_PX, top, left, _NOISE)

    def _window(self, block: tuple[int, int, int, int]) -> "Window":
        """Collect the pixels of all surfaces that any view may show in a block."""
        from mrbokeh.layering._pupil_views_numba import Window, collect

        margin = -self.frame.left_px
        width, height = self.frame.width_px + 2 * margin, self.frame.height_px + 2 * margin
        top, bottom, left, right = (each + margin for each in block)
        around = self._reach_px
        box = max(top - around, 0), min(bottom + around, height), max(left - around, 0), min(right + around, width)
        most = (box[1] - box[0]) * (box[3] - box[2]) * len(self.surfaces)
        x_px, y_px, half_px, alpha = (np.empty(most, np.float32) for _ in range(4))
        starts = np.zeros((len(self.surfaces), box[1] - box[0] + 1), np.int64)
        window = Window(
            x_px=x_px,
            y_px=y_px,
            half_px=half_px,
            alpha=alpha,
            rgb=np.empty((most, 3), np.float32),
            starts=starts,
            range_px=np.array([np.inf, -np.inf], np.float32),
            top_px=box[0] - top,
        )
        end = 0
        for number, each in enumerate(self.surfaces):
            end = collect(window, number, end, (top, left), box, width, each.places, each.values, each.coc_px)
        return window
