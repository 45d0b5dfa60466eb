"""Slices: pixels of layers sorted by the circle of confusion, blurred one slice at a time and composited front to back.

A slice of a slanted or rolling surface is a ring or a few patches in a window that is mostly empty, and blurring costs by the window.
So the pixels of a slice are divided into connected components so far apart that their light does not meet, each blurred in a window of
its own. Components' lights do not overlap, so it makes no difference which of them claims its share of the pupil first.
"""

from collections.abc import Iterator, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass, replace
from functools import partial
from heapq import merge
from operator import itemgetter

import numpy as np
from jaxtyping import Float32

from mrbokeh.layering.padded_layers import Part, Pixels, Shares
from mrbokeh.layering.psf_over_field import Frame, PsfField
from mrbokeh.system.resources import ZeroedMemory, ahead, bands, cores, in_bands

_SORTED_PIXELS = 1 << 14
Window = tuple[slice, slice]
_LEAST_CELL_PX = 16
_MOST_CELLS = 64
_PIXELS_PER_BLUR = 1 << 14
"""Cost of blurring once more, in pixels of a window."""
LEAST_STEP_PX = 0.5
_HALF_A_SLICE = 0.501  # and what rounding may add
_BAND_PIXELS = 1 << 16
_FEWEST_PIXELS = 1 << 19
_FEW_PIXELS = 1 << 20
_MANY_PIXELS = 1 << 22
SHARP_PX = np.float32(6.0)  # up to this diameter what is seen is worth more than what may hide: measured on traced scenes
Plane = Float32[np.ndarray, "height width"]
Channels = Float32[np.ndarray, "height width _"]
_Shown = tuple[list[Shares], list[Shares]]
"""Shares of the pixels of each layer that the pinhole picture shows, and of those hidden behind something across the focus."""


@dataclass(frozen=True)
class Slicing:
    """Facts shared by all slices: the PSF, their largest number, the frame, threads and memory.

    frame: placement of arrays with their margin. pool: threads for slices and components.
    """

    psf: PsfField
    slices: int
    frame: Frame
    pool: Executor
    memory: ZeroedMemory

    @property
    def size(self) -> tuple[int, int]:
        """Height and width of arrays with their margin."""
        return self.frame.height_px - 2 * self.frame.top_px, self.frame.width_px - 2 * self.frame.left_px

    @property
    def at_once(self) -> int:
        """Components under way or waiting to be claimed: many for small frames, so that nobody waits for a large one whose turn it is; few
        for frames of which each component keeps all cores busy; else one.
        """
        pixels = self.size[0] * self.size[1]
        if pixels <= _FEWEST_PIXELS:
            return 5 * cores()
        return cores() + 2 if pixels <= _FEW_PIXELS else 2 if pixels <= _MANY_PIXELS else 1

    def blur_component(self, component: tuple[Sequence[Part], int]) -> list[tuple[Channels, Window]]:
        """Return the blurred light of a component (its parts and how far light travels at most) and the window where it lies, round by
        round.

        If pixels of two layers share a place there are two rounds or more.
        """
        from mrbokeh.layering._slices_numba import place_light, remove_light

        parts, reach = component
        rounds: list[tuple[Channels, Window]] = []
        while parts and (window := window_of(parts, reach, self.frame)) is not None:
            channels = parts[0].pixels.values.shape[1]
            memory = self.memory.take(self.size[0] * self.size[1] * (channels + 1), np.float32)
            light, coc_px = _laid_out(memory, window, channels)
            where = self.size[1], window[0].start, window[1].start
            late = [
                place_light(light, coc_px, each.runs, each.pixels.places, each.pixels.values, each.pixels.coc_px, each.shares, *where)
                for each in parts
            ]
            blurred = self.psf.blur(light, coc_px, self.frame.moved(window[1].start, window[0].start))
            rounds.append((blurred.copy() if np.may_share_memory(blurred, memory) else blurred, window))
            for part in parts:
                remove_light(light, coc_px, part.runs, part.pixels.places, *where)
            self.memory.give_back(memory)
            parts = [replace(part, runs=runs) for part, runs in zip(parts, late, strict=True) if len(runs) > 0]
        return rounds


def _laid_out(memory: Float32[np.ndarray, " elements"], window: Window, channels: int) -> tuple[Channels, Plane]:
    """Return the beginning of the memory as light and circles of confusion of a window."""
    rows, columns = window[0].stop - window[0].start, window[1].stop - window[1].start
    elements = rows * columns * channels
    return memory[:elements].reshape(rows, columns, channels), memory[elements : elements + rows * columns].reshape(rows, columns)


def composited(layers: Sequence[Pixels], slicing: Slicing, by_depth: bool) -> tuple[Channels, Channels]:
    """Return all layers as the lens sees them, composited front to back: colour (H, W, 3 + E) and how much of the pupil is taken (H, W,
    1 or 3).

    by_depth: the layer that the pinhole picture shows at a pixel is the nearest, else the first in order (slices are always by depth).
    The pupil is counted per colour where the optics are chromatic.
    """
    from mrbokeh.layering._slices_numba import claim

    frame, channels = slicing.frame, layers[0].values.shape[1]
    colour = np.zeros((frame.height_px, frame.width_px, channels - 1), np.float32)
    taken = np.zeros((frame.height_px, frame.width_px, slicing.psf.coverages), np.float32)
    shown = None
    if len(layers) > 1:
        shown = _shown_by_depth(layers, slicing.size) if by_depth else _shown_in_order(layers, slicing)
    for rounds in ahead(slicing.pool, slicing.blur_component, _components_in_turn(layers, shown, slicing), slicing.at_once):
        for light, (rows, columns) in rounds:
            claim(colour, taken, light, rows.start + frame.top_px, columns.start + frame.left_px)
    return colour, taken


def _components_in_turn(layers: Sequence[Pixels], shown: _Shown | None, slicing: Slicing) -> Iterator[tuple[list[Part], int]]:
    """Yield components of slices and how far their light travels at most, in the order in which they claim the pupil.

    shown: shares of the pixels of several layers.
    """
    nearest, farthest = _range_px(layers, slicing.size[0] * slicing.size[1])
    step_px = max((farthest - nearest) / slicing.slices, LEAST_STEP_PX)
    cut = partial(sorted_slices, layers, step_px=step_px, width=slicing.size[1], pool=slicing.pool)
    for together in _shares_in_turn(layers, shown):
        for k, parts in merge(*map(cut, together), key=itemgetter(0)):
            largest_px = min((abs(k) + _HALF_A_SLICE) * step_px, max(-nearest, farthest))
            reach = slicing.psf.reach_px(parts, largest_px, slicing.frame)
            for component in connected_components(parts, reach, slicing.size):
                yield component, reach


def _shares_in_turn(layers: Sequence[Pixels], shown: _Shown | None) -> Iterator[list[list[Shares]]]:
    """Yield shares of the pixels in the order in which they claim the pupil; those that come together, slice by slice in the order given.

    First, front to back, the pixels that the pinhole picture shows; last the hidden ones. But pixels hidden behind something on the other
    side of the focus go right before their slice: kernels are mirrored at the focus, so the pupil that an edge leaves free looks behind
    it.
    """
    if shown is None:
        yield [[np.ones_like(layer.coc_px) for layer in layers]]
        return
    seen, crossing = shown
    yield [crossing, seen]
    yield [[1.0 - share - across for share, across in zip(seen, crossing, strict=True)]]


def _range_px(layers: Sequence[Pixels], pixels: int) -> tuple[float, float]:
    """Return the least and the greatest circle of confusion; uncovered pixels of a layer count as in focus."""
    in_focus = [0.0] if any(len(layer.places) < pixels for layer in layers) else []
    used = [layer.coc_px for layer in layers if len(layer.places) > 0]
    return float(min([*in_focus, *(coc_px.min() for coc_px in used)])), float(max([*in_focus, *(coc_px.max() for coc_px in used)]))


def _shown_in_order(layers: Sequence[Pixels], slicing: Slicing) -> _Shown:
    """Return how much of each pixel the layers listed before leave uncovered, and how much hides behind one on the other side of the
    focus.
    """
    from mrbokeh.layering._slices_numba import cover

    pixels = slicing.size[0] * slicing.size[1]
    free, nearest_px = np.ones(pixels, np.float32), np.zeros(pixels, np.float32)
    shown, crossing = ([np.empty_like(layer.coc_px) for layer in layers] for _ in range(2))

    def cover_band(first: int, end: int) -> None:
        for each, across, layer in zip(shown, crossing, layers, strict=True):
            start, stop = layer.places.searchsorted(np.array((first, end), layer.places.dtype))
            cover(each, across, free, nearest_px, layer.places, layer.values, layer.coc_px, SHARP_PX, start, stop)

    in_bands(slicing.pool, pixels, _BAND_PIXELS, cover_band)
    return shown, crossing


def _shown_by_depth(layers: Sequence[Pixels], size: tuple[int, int]) -> _Shown:
    """Return the same as `_shown_in_order` for nearer layers; of layers at one depth those listed before count as nearer."""
    shown, crossing = ([np.full_like(layer.coc_px, value) for layer in layers] for value in (1.0, 0.0))
    for j, front in enumerate(layers):
        coverage, coc_px = np.zeros(size[0] * size[1], np.float32), np.zeros(size[0] * size[1], np.float32)
        coverage[front.places], coc_px[front.places] = front.values[:, 3], front.coc_px
        for i, layer in enumerate(layers):
            if i != j:
                there_px, over = coc_px[layer.places], coverage[layer.places]
                nearer = there_px <= layer.coc_px if j < i else there_px < layer.coc_px
                shown[i] *= np.where(nearer, np.float32(1.0) - over, np.float32(1.0))
                crossing[i][(over > 0) & (there_px < -SHARP_PX) & (layer.coc_px > SHARP_PX)] = 1.0
    return shown, [across * (np.float32(1.0) - each) for across, each in zip(crossing, shown, strict=True)]


def sorted_slices(
    layers: Sequence[Pixels], shares: Sequence[Shares], step_px: float, width: int, pool: Executor
) -> list[tuple[int, list[Part]]]:
    """Return number and parts of each slice that is not empty, front first; a slice holds circles of confusion nearest to its number times
    the step.

    width: of the frame that places are counted in.
    """
    from mrbokeh.layering._slices_numba import runs_of_slices

    used = [(layer, share) for layer, share in zip(layers, shares, strict=True) if share.any()]
    of_runs, runs = [], []
    for layer, share in used:
        pixels = layer.places, layer.coc_px, share, width, np.float32(step_px)
        found = list(pool.map(partial(runs_of_slices, *pixels), *zip(*bands(len(share), _SORTED_PIXELS), strict=True)))
        all_runs = np.concatenate([np.empty((0, 3), np.int32), *found])
        all_runs = all_runs[np.argsort(all_runs[:, 0], kind="stable")]
        of_runs.append(all_runs[:, 0].copy())
        runs.append(all_runs[:, 1:].copy())
    slices = np.unique(np.concatenate([np.empty(0, np.int32), *of_runs]))
    cuts = [np.split(of_layer, np.searchsorted(numbers, slices[1:])) for numbers, of_layer in zip(of_runs, runs, strict=True)]
    parts = [[Part(*each, cut) for each, cut in zip(used, cut_of, strict=True) if len(cut) > 0] for cut_of in zip(*cuts, strict=True)]
    return list(zip(slices.tolist(), parts, strict=True))


def window_of(parts: Sequence[Part], reach: int, frame: Frame) -> Window | None:
    """Return the smallest window that holds these pixels, as far as they are seen, and where they are seen; None if nothing is.

    reach: how many pixels their light travels at most. Rows and columns are those of an array that lies as the frame says.
    """
    from mrbokeh.layering._slices_numba import extent

    width = frame.width_px - 2 * frame.left_px
    tops, bottoms, lefts, rights = zip(*(extent(part.runs, part.pixels.places, width) for part in parts), strict=True)
    rows = _span(min(tops), max(bottoms), reach, -frame.top_px, frame.height_px)
    columns = _span(min(lefts), max(rights), reach, -frame.left_px, frame.width_px)
    return None if rows is None or columns is None else (rows, columns)


def _span(first: int, end: int, reach: int, inside: int, length: int) -> slice | None:
    """Return the range of pixels first to end that reach the inside, together with the part of the inside that they reach; None if none
    does.
    """
    first, end = max(first, inside - reach), min(end, inside + length + reach)
    return slice(min(first, max(first - reach, inside)), max(end, min(end + reach, inside + length))) if first < end else None


def connected_components(parts: Sequence[Part], reach: int, size: tuple[int, int]) -> Iterator[list[Part]]:
    """Yield the parts of a slice, component by component. reach: pixels that light travels at most. size: height and width of the frame
    with its margin.
    """
    from mrbokeh.layering._slices_numba import components_of_runs, join_components, label_components, mark_cells

    cell_px = max(_LEAST_CELL_PX, 2 * reach, -(-max(size) // _MOST_CELLS))
    cells = np.zeros((-(-size[0] // cell_px), -(-size[1] // cell_px)), np.int32)
    for part in parts:
        mark_cells(cells, cell_px, part.runs, part.pixels.places, size[1])
    boxes = np.tile(np.array([size[0], 0, size[1], 0]), (label_components(cells), 1))
    own = [components_of_runs(boxes, cells, cell_px, part.runs, part.pixels.places, size[1]) for part in parts]
    joined = join_components(boxes, reach, _PIXELS_PER_BLUR)
    if not joined.any():
        yield list(parts)
        return
    for component in np.unique(joined):
        cut = [replace(part, runs=part.runs[joined[of_runs] == component]) for part, of_runs in zip(parts, own, strict=True)]
        yield [part for part in cut if len(part.runs) > 0]
