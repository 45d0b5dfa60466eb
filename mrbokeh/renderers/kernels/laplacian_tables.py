"""Tables of kernels as points: the kernel that a pixel takes, and the points of all kernels that a picture needs, kept from call to
call.
"""

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from jaxtyping import Bool, Float, Float32, Float64, Int, Int32, Int64

from mrbokeh.optics.aperture import Aperture
from mrbokeh.renderers.kernels.spreadlets import Sparsification, Spreadlet, sparsify, whole_laplacian
from mrbokeh.system.console import track
from mrbokeh.system.errors import InputError
from mrbokeh.system.resources import cores, in_bands, workers

DENSE, SPARSE, WHOLE = 0, 1, 2
DENSE_PER_PX = 32.0
LEVELS_PER_OCTAVE = 64.0
_BLOCK = 4096  # codes per kind and side
_MOST_KERNELS = 8192  # that are kept between calls
_SHOW_FROM = 8
_ROWS_AT_ONCE = 64
AROUND_PX, OUTSHINES = 8, 8.0


@dataclass(frozen=True)
class Points:
    """Points of the cells in use: xy (N, 2), weights (N,), cell i at starts[i]:starts[i + 1], sorted by y within a cell."""

    xy: Int32[np.ndarray, "points 2"]
    weights: Float64[np.ndarray, " points"]
    starts: Int64[np.ndarray, " starts"]
    reach_px: int


@dataclass
class KernelTables:
    """Kernels of plain apertures by diameter: all taps up to dense_up_to_px, spreadlets beyond."""

    dense_up_to_px: float
    sparsification: Sparsification | None
    kept: dict[tuple[bytes, int, bool], Spreadlet] = field(default_factory=dict)

    @cached_property
    def _borders_px(self) -> Float32[np.ndarray, " borders"]:
        """The smallest diameter of each level beyond dense_up_to_px, then a few infinite ones."""
        from mrbokeh.renderers.kernels._laplacian_numba import NEAR

        levels = np.arange(_BLOCK + 2 * NEAR)
        sizes_px = self.dense_up_to_px * 2.0 ** ((levels - 0.5) / LEVELS_PER_OCTAVE)
        return np.where(levels < _BLOCK, sizes_px, np.inf).astype(np.float32)

    def codes(
        self,
        out: Float32[np.ndarray, "height width channels"],
        values: Float32[np.ndarray, "height width channels"],
        coc_px: Float32[np.ndarray, "height width"],
        aperture: Aperture,
    ) -> Int32[np.ndarray, "height width"]:
        """Return codes of the kernels, -1 for sharp and dark pixels; sharp ones are copied to out."""
        from mrbokeh.renderers.kernels._laplacian_numba import Limits, choose_cells

        codes = np.empty(coc_px.shape, np.int32)
        large = np.abs(coc_px) > self.dense_up_to_px
        bright = stands_out(values) if self.sparsification is not None and large.any() else np.zeros(coc_px.shape, np.bool_)
        limits = Limits(
            sharp_up_to_px=1.0 / aperture.unit_radius,
            dense_up_to_px=self.dense_up_to_px,
            dense_per_px=DENSE_PER_PX,
            levels_per_octave=LEVELS_PER_OCTAVE,
            borders_px=self._borders_px,
            blocks=_BLOCK,
        )

        def choose(first: int) -> bool:
            rows = slice(first, first + _ROWS_AT_ONCE)
            return choose_cells(codes[rows], out[rows], values[rows], coc_px[rows], bright[rows], limits)

        with workers(codes.size) as pool:
            all_finite = all(list(pool.map(choose, range(0, len(codes), _ROWS_AT_ONCE))))
        if not all_finite:
            raise InputError("every visible pixel needs a finite circle of confusion: depth must be positive (or inf), not 0 or NaN")
        return codes

    def points(self, codes: Sequence[int], aperture: Aperture, threads: int, dense: bool = False) -> Points:
        """Return the points of these codes, in their order; new ones are computed and kept. dense: all taps, whatever the code says."""
        vertices, starts, weights = aperture.packed()
        key = vertices.tobytes() + starts.tobytes() + weights.tobytes()
        if len(self.kept) > _MOST_KERNELS:
            self.kept.clear()
        found = {code: self.kept.get((key, code, dense)) for code in codes}
        new = [code for code, spreadlet in found.items() if spreadlet is None]
        slow = not dense and sum(kind_of(code) == SPARSE for code in new) >= _SHOW_FROM
        with ThreadPoolExecutor(threads or cores()) as pool:
            made = pool.map(lambda code: self._computed(code, aperture, dense), new)
            for code, spreadlet in zip(new, track(made, "spreadlets", len(new)) if slow else made, strict=True):
                found[code] = self.kept[key, code, dense] = by_rows(spreadlet)
        return joined_points([found[code] for code in codes])

    def diameter_px(self, code: int) -> float:
        """Return the signed diameter that a code stands for."""
        level, sign = code % _BLOCK, -1.0 if code >= 3 * _BLOCK else 1.0
        size = level / DENSE_PER_PX if kind_of(code) == DENSE else self.dense_up_to_px * 2.0 ** (level / LEVELS_PER_OCTAVE)
        return sign * size

    def _computed(self, code: int, aperture: Aperture, dense: bool) -> Spreadlet:
        kernel, kind = aperture.rasterize(self.diameter_px(code)).kernel, kind_of(code)
        if dense or kind == DENSE:
            return taps_of(kernel)
        return whole_laplacian(kernel) if kind == WHOLE or self.sparsification is None else sparsify(kernel, self.sparsification)


def taps_of(kernel: Float[np.ndarray, "size size *channels"]) -> Spreadlet:
    """Return all pixels of a kernel that are not 0, as points."""
    colours = kernel.reshape(*kernel.shape[:2], -1).astype(np.float64)
    rows, columns = np.nonzero(np.any(colours != 0.0, axis=2))
    xy = np.stack([columns, rows], axis=1) - kernel.shape[0] // 2
    return Spreadlet(xy.astype(np.int16), colours[rows, columns])


def kind_of(code: int) -> int:
    """Return DENSE, SPARSE or WHOLE."""
    return code // _BLOCK % 3


def by_rows(cell: Spreadlet) -> Spreadlet:
    """Return the same points sorted by row."""
    order = np.lexsort((cell.points[:, 0], cell.points[:, 1]))
    return Spreadlet(cell.points[order], cell.values[order])


def joined_points(cells: Sequence[Spreadlet | None], channel: int = 0) -> Points:
    """Join cells that are sorted by row, leaving out None; weights of one channel."""
    some = [cell for cell in cells if cell is not None]
    xy = np.concatenate([each.points for each in some]).astype(np.int32)
    weights = np.concatenate([each.values[:, channel] for each in some])
    starts = np.cumsum([0, *(len(each.points) for each in some)]).astype(np.int64)
    return Points(xy, weights, starts, int(np.abs(xy).max(initial=0)))


def stands_out(values: Float32[np.ndarray, "height width channels"]) -> Bool[np.ndarray, "height width"]:
    """Return a mask of pixels that outshine the mean of their surroundings in any channel: highlights and lone pixels, whose PSF can be
    seen.
    """
    from mrbokeh.renderers.kernels._laplacian_numba import find_outshining

    light = np.ascontiguousarray(values, np.float32)
    found = np.zeros(values.shape[:2], np.bool_)
    with workers(found.size) as pool:
        in_bands(pool, len(light), _ROWS_AT_ONCE, lambda first, end: find_outshining(found, light, AROUND_PX, OUTSHINES, first, end))
    return found


def used_codes(codes: Int[np.ndarray, "height width"]) -> Int[np.ndarray, " codes"]:
    """Return the codes that occur, but -1, ascending; without sorting all pixels."""
    from mrbokeh.renderers.kernels._laplacian_numba import mark_used

    used = np.zeros(int(codes.max(initial=-1)) + 1, np.bool_)
    mark_used(used, codes)
    return np.flatnonzero(used)
