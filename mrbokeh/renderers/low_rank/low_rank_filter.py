"""Low-rank filters: every pixel's PSF as a sum of few separable kernels (McGraw, Fast Bokeh Effects Using Low-Rank Linear Filters).

The blur of a picture changes from pixel to pixel, and a separable filter whose width changes between its two passes is not the blur
that was asked for. Here the pixels are sorted by diameter instead: each gives its light to the two tabulated kernels next to its own,
and all light of one kernel is an even, truly separable scatter. Edges of depth need no mask then, and no light is lost or doubled.

What it costs: the light of a pixel is not exactly its PSF. The low-rank sum ripples within the square around the kernel
(in the corners too, where the kernel has ended) with a norm of `relative_error` of the kernel's, and blending two kernels
adds up to 3 % to that. Ripples average out over an even field (exactly), a texture and even an edge: an edge from 0 to 1 is
within 0.003 of its exact blur at the default. They do not average out for highlights: those are summed by their exact kernels,
see mrbokeh.renderers.low_rank.exact_scatter. Beside a bright area that just fails to count as one, the dark is off by a tenth of its
own light.

McGraw's own way is kept to compare with: two passes whose width changes from pixel to pixel. The second knows the pixels that the first
reached, not where their light came from, and filters by the diameter found there, which is wrong near an edge of depth. As in the paper,
edges are found by finite differences, grown by the blur and left to full 2D filtering.
`tilt_shift` blurs a photograph by a map that somebody drew, without any depth (McGraw, Section 4 and Fig. 14): a tilted lens keeps a
wedge of space sharp, and a gradient of blur drawn over a photograph looks alike and makes the subject seem small.
"""

from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from functools import cached_property, partial

import numpy as np
from jaxtyping import Bool, Float32, Float64, Int

from mrbokeh.images.layer import Layer
from mrbokeh.layering.layering import Layering, render_layers
from mrbokeh.optics.aperture import Aperture
from mrbokeh.optics.lens import Lens
from mrbokeh.optics.psf import kernel_radius_px
from mrbokeh.optics.psf_bank import PsfBank
from mrbokeh.renderers.bank.renderers import BankRenderer, BankTerms, KernelOpening, by_low_rank
from mrbokeh.renderers.kernels.low_rank_kernel import Levels, LowRankKernel, Taps, decompose, levels_of, taps_of
from mrbokeh.renderers.low_rank.exact_scatter import LEAST_RADIUS_PX, exact_share, scatter_exactly
from mrbokeh.system.errors import InputError
from mrbokeh.system.resources import cores

EDGE_PX = 1.0
"""Where neighbouring pixels differ by more than this in signed diameter, there is an edge."""
_STEP_PX = 0.5
_PIECE_PX = 64


def depth_edge_mask(
    coc_px: Float32[np.ndarray, "height width"], lit: Bool[np.ndarray, "height width"], unit_radius: float
) -> Bool[np.ndarray, "height width"]:
    """Return a mask of the pixels within whose reach there is an edge: an abrupt change of the (signed) diameter, or a pixel without light.

    The reach of a pixel is the square around it that its kernel takes, rounded up to a power of two.
    """
    import cv2

    edges = ~lit
    signed_px = np.where(lit, coc_px, np.float32(0.0))
    for axis in (0, 1):
        steep = np.abs(np.diff(signed_px, axis=axis)) > EDGE_PX
        pad = [(0, 1) if axis == each else (0, 0) for each in (0, 1)]
        edges |= np.pad(steep, pad) | np.pad(steep, [each[::-1] for each in pad])
    radii_px = 0.5 * unit_radius * np.abs(signed_px) + 0.5
    mask = edges.copy()
    radius_px = 1
    while radius_px < 2.0 * radii_px.max():
        window = np.ones((2 * radius_px + 1, 2 * radius_px + 1), np.uint8)
        near = cv2.dilate(edges.astype(np.uint8), window, borderType=cv2.BORDER_CONSTANT, borderValue=0) > 0
        mask |= near & (radii_px > radius_px / 2) & (radii_px <= radius_px)
        radius_px *= 2
    return mask & lit


def scatter_per_pixel(
    out: Float32[np.ndarray, "height width channels"],
    values: Float32[np.ndarray, "height width channels"],
    shares: Float32[np.ndarray, "height width"],
    diameters_px: Float32[np.ndarray, "height width"],
    kernel_at: Callable[[float], LowRankKernel],
    mirrored: bool,
    each: Callable[[Callable, Iterable], Iterable] = map,
) -> None:
    """Add share * value of every pixel to out, term by term, across and then down; diameters_px unsigned."""
    from mrbokeh.renderers.low_rank._filter_numba import across, down

    columns, rows, radii_px = _tables(float(diameters_px.max()), kernel_at, mirrored)
    positions = diameters_px / np.float32(_STEP_PX)
    middle = np.empty_like(values)
    height, width = diameters_px.shape
    for term in range(columns.shape[0]):

        def run_across(top: int, table: np.ndarray = rows[term]) -> None:
            part = slice(top, top + _PIECE_PX)
            across(middle[part], values[part], shares[part], positions[part], table, radii_px)

        def run_down(left: int, table: np.ndarray = columns[term]) -> None:
            part = np.s_[:, left : left + _PIECE_PX]
            down(out[part], middle[part], positions[part], table, radii_px)

        list(each(run_across, range(0, height, _PIECE_PX)))
        list(each(run_down, range(0, width, _PIECE_PX)))


def _tables(
    largest_px: float, kernel_at: Callable[[float], LowRankKernel], mirrored: bool
) -> tuple[Float32[np.ndarray, "terms levels size"], Float32[np.ndarray, "terms levels size"], Int[np.ndarray, " levels"]]:
    """Return scaled columns and rows of the kernels at all steps up to the largest diameter, term by term in step with one another."""
    kernels = [kernel_at(_STEP_PX * i) for i in range(int(np.ceil(largest_px / _STEP_PX)) + 2)]
    terms, size = max(kernel.rank for kernel in kernels), 2 * max(kernel.radius_px for kernel in kernels) + 1
    columns, rows = np.zeros((len(kernels), terms, size)), np.zeros((len(kernels), terms, size))
    for i in reversed(range(len(kernels))):
        kernel = kernels[i]
        inset = size // 2 - kernel.radius_px
        part = np.s_[i, : kernel.rank, inset : size - inset]
        columns[part], rows[part] = kernel.scaled_columns, kernel.scaled_rows
        if i + 1 < len(kernels):
            _put_in_step(columns[i], rows[i], columns[i + 1], rows[i + 1])
    order = slice(None, None, -1) if mirrored else slice(None)
    by_term = [np.ascontiguousarray(each.transpose(1, 0, 2)[..., order], np.float32) for each in (columns, rows)]
    return by_term[0], by_term[1], np.array([kernel.radius_px for kernel in kernels])


def _put_in_step(
    columns: Float64[np.ndarray, "terms size"],
    rows: Float64[np.ndarray, "terms size"],
    next_columns: Float64[np.ndarray, "terms size"],
    next_rows: Float64[np.ndarray, "terms size"],
) -> None:
    """Reorder terms and flip signs so that every term is most like the same term of the next larger kernel; in place.

    Singular vectors come in any order of nearly equal weights and with any sign, which would make a blend of two meaningless.
    """
    likeness = (next_columns @ columns.T) * (next_rows @ rows.T)
    free = list(range(len(columns)))
    order = np.zeros(len(columns), int)
    for term in range(len(columns)):
        order[term] = free.pop(int(np.argmax(likeness[term, free])))
    columns[:], rows[:] = columns[order], rows[order]
    signs = np.where(np.sum(columns * next_columns, axis=1) < 0, -1.0, 1.0)[:, None]
    columns *= signs
    rows *= signs


_PIECE_ROWS, _PIECE_TILES = 192, 4  # fixed pieces of work: the result does not depend on the number of threads
_MOST_CHANNELS = 16  # at once
_LEAST_RANK = 4  # with fewer terms, kernels of 11 to 17 px save next to nothing and show it at edges
_MOST_KERNELS = 4096  # that are kept between calls


@dataclass(frozen=True)
class LowRankFilter:
    """Renderer that sums low-rank kernels; layers, slices and hidden background as in mrbokeh.layering.layering.

    relative_error: the rank of every kernel is the least from 4 on with this error (McGraw, Eq. 4), at most max_rank.
    per_pixel: McGraw's two passes of varying width with a mask near edges of depth, in place of levels (slower, less exact).
    threads: 0 takes all cores.
    bank: kernels to use instead of the lens's aperture (blur of up to 1 px stays sharp, other kernels are blended between
      those of the bank around a pixel); terms: its own, if they have been computed before.

    It is linear but for two steps. Which pixels count as highlights depends on ratios to their surroundings: light scaled as
    a whole gives the scaled result, but two pictures spread apart may not add up to their sum to better than relative_error
    of the highlights. And where no light is negative, results below 0 (ripples just outside a bright area) are set to 0,
    which adds at most 0.003 of its brightness per pixel of a bright area's outline.
    """

    relative_error: float = 0.1
    max_rank: int = 16
    layering: Layering = field(default_factory=Layering)
    per_pixel: bool = False
    threads: int = 0
    bank: PsfBank | None = None
    terms: BankTerms | None = field(default=None, repr=False)
    _kernels: dict[tuple[bytes, float], LowRankKernel] = field(default_factory=dict, repr=False, compare=False)

    def __post_init__(self) -> None:
        if not 0.0 <= self.relative_error < 1.0 or self.max_rank < 1:
            raise InputError(
                f"a low-rank filter needs a relative error from 0 to below 1 and a rank of at least 1, "
                f"got {self.relative_error} and {self.max_rank}"
            )

    def render(self, layers: Sequence[Layer], lens: Lens) -> Layer:
        if self._of_bank is None or not layers:
            return render_layers(layers, lens, self.sum_kernels, self.layering)
        return self._of_bank.render(layers, lens, self.layering)

    @cached_property
    def _of_bank(self) -> BankRenderer | None:
        return None if self.bank is None else by_low_rank(self.bank, self.terms, self.sum_kernels)

    def sum_kernels(
        self,
        values: Float32[np.ndarray, "height width channels"],
        coc_px: Float32[np.ndarray, "height width"],
        aperture: Aperture | KernelOpening,
    ) -> Float32[np.ndarray, "height width channels"]:
        """Sum kernels as mrbokeh.layering.psf_over_field.KernelSum says."""
        if values.shape[2] > _MOST_CHANNELS:
            parts = [values[..., at : at + _MOST_CHANNELS] for at in range(0, values.shape[2], _MOST_CHANNELS)]
            return np.concatenate([self.sum_kernels(np.ascontiguousarray(part), coc_px, aperture) for part in parts], axis=2)
        from mrbokeh.renderers.kernels._low_rank_numba import one_side

        with ThreadPoolExecutor(self.threads or cores()) as pool:
            out, diameters_px, sides, signed = _split(values, coc_px, 1.0 / aperture.unit_radius, pool.map)
            for sign in sides:
                self._add_side(out, values, one_side(diameters_px, sign), coc_px, aperture, sign, pool.map)
        if sides and not signed.all():
            np.maximum(out, np.where(signed, -np.inf, 0.0).astype(np.float32), out=out)
        return out

    def _add_side(
        self,
        out: Float32[np.ndarray, "height width channels"],
        values: Float32[np.ndarray, "height width channels"],
        diameters_px: Float32[np.ndarray, "height width"],
        coc_px: Float32[np.ndarray, "height width"],
        aperture: Aperture | KernelOpening,
        sign: int,
        each: Callable[[Callable, Iterable], Iterable],
    ) -> None:
        """Add the light of all pixels that have a diameter here, all of one side of the focus, to out."""
        exact = exact_share(values, diameters_px, aperture.unit_radius, each)
        if self.per_pixel:
            exact[depth_edge_mask(coc_px, np.any(values != 0, axis=-1), aperture.unit_radius) & (diameters_px > 0)] = 1.0
        scatter_exactly(out, values, exact, diameters_px, aperture, sign, each)
        if not ((exact < 1.0) & (diameters_px > 0)).any():
            return
        shares = np.where(diameters_px > 0, np.float32(1.0) - exact, np.float32(0.0))
        kernel_at = partial(self._kernel, aperture)
        if self.per_pixel:
            scatter_per_pixel(out, values, shares, diameters_px, kernel_at, sign < 0, each)
            return
        levels = aperture.levels(diameters_px, exact) if isinstance(aperture, KernelOpening) else levels_of(diameters_px, exact)
        _scatter_levels(out, values, shares, levels, taps_of(levels, kernel_at, sign < 0), each)

    def decomposed(self, kernel: Float64[np.ndarray, "size size"]) -> LowRankKernel:
        """Decompose a kernel into as few terms as the settings allow; small ones at full rank."""
        small = len(kernel) // 2 < LEAST_RADIUS_PX
        return decompose(kernel) if small else decompose(kernel, self.relative_error, self.max_rank, _LEAST_RANK)

    def _kernel(self, aperture: Aperture | KernelOpening, diameter_px: float) -> LowRankKernel:
        """Return the decomposed PSF, kept for the next call."""
        if isinstance(aperture, KernelOpening):
            return aperture.low_rank(diameter_px, self.decomposed)
        vertices, starts, weights = aperture.packed()
        key = vertices.tobytes() + starts.tobytes() + weights.tobytes(), diameter_px
        if key not in self._kernels:
            if len(self._kernels) >= _MOST_KERNELS:
                self._kernels.clear()
            self._kernels[key] = self.decomposed(aperture.rasterize(diameter_px).kernel)
        return self._kernels[key]


def _split(
    values: Float32[np.ndarray, "height width channels"],
    coc_px: Float32[np.ndarray, "height width"],
    sharp_up_to_px: float,
    each: Callable[[Callable, Iterable], Iterable],
) -> tuple[Float32[np.ndarray, "height width channels"], Float32[np.ndarray, "height width"], list[int], Bool[np.ndarray, " channels"]]:
    """Return the sharp pixels, the signed diameters of the others (else 0), the signs among them, and the channels with negative
    values.
    """
    from mrbokeh.renderers.kernels._low_rank_numba import BEHIND, IN_FRONT, NOT_FINITE, prepare

    height, width, channels = values.shape
    out, diameters_px = np.empty_like(values), np.empty((height, width), np.float32)
    tops = range(0, height, _PIECE_ROWS)
    signed = np.zeros((len(tops), channels), bool)

    def run(top: int) -> int:
        rows = slice(top, top + _PIECE_ROWS)
        return prepare(out[rows], diameters_px[rows], values[rows], coc_px[rows], sharp_up_to_px, signed[top // _PIECE_ROWS])

    flags = 0
    for found in each(run, tops):
        flags |= found
    if flags & NOT_FINITE:
        raise InputError("every visible pixel needs a finite circle of confusion: depth must be positive (or inf), not 0 or NaN")
    return out, diameters_px, [sign for sign, flag in ((1, BEHIND), (-1, IN_FRONT)) if flags & flag], np.any(signed, axis=0)


def _scatter_levels(
    out: Float32[np.ndarray, "height width channels"],
    values: Float32[np.ndarray, "height width channels"],
    shares: Float32[np.ndarray, "height width"],
    levels: Levels,
    taps: Taps,
    each: Callable[[Callable, Iterable], Iterable],
) -> None:
    """Add share * value of every pixel that has a level, blurred by its low-rank kernels, to out."""
    from mrbokeh.renderers.kernels._low_rank_numba import level_spans
    from mrbokeh.renderers.low_rank._filter_numba import TILE_FLOATS, Kernels, Source, scatter_piece

    spans = level_spans(levels.level, levels.upper, TILE_FLOATS // values.shape[2])
    height, tiles = spans.shape[:2]
    source = Source(values=values, shares=shares, levels=levels.level, uppers=levels.upper, spans=spans)
    kernels = Kernels(taps.columns, taps.rows, taps.ranks, taps.radii_px)

    def run(piece: tuple[int, int]) -> None:
        top, first = piece
        scatter_piece(out, source, kernels, top, min(height, top + _PIECE_ROWS), first, min(tiles, first + _PIECE_TILES))

    list(each(run, [(top, first) for top in range(0, height, _PIECE_ROWS) for first in range(0, tiles, _PIECE_TILES)]))


_LEAST_COVERAGE = 1e-6


def tilt_shift(
    rgb: Float32[np.ndarray, "height width 3"],
    coc_px: Float32[np.ndarray, "rows columns"],
    aperture: Aperture,
    rank: int = 3,
    threads: int = 0,
) -> Float32[np.ndarray, "height width 3"]:
    """Return a scene-linear picture with every pixel blurred by its own diameter (0 along the band to keep, growing smoothly away from
    it), and the sum divided by how much arrived.

    coc_px: from 0 (kept; anything below 1 px is) to any size; negative diameters mirror the aperture. Steps in the map are
    allowed and give what no depth can order: light of both sides mixes across them. aperture: plain.
    rank: terms per kernel, 3 as in the paper; kernels up to 9 px take as many as they need. threads: 0 takes all cores.
    The picture is continued beyond its border by its mirror image; an even picture stays even.
    """
    if rgb.ndim != 3 or rgb.shape[2] != 3 or rgb.shape[:2] != coc_px.shape:
        raise InputError(f"tilt-shift needs a picture (H, W, 3) and a map of diameters (H, W), got {rgb.shape} and {coc_px.shape}")
    if not np.isfinite(rgb).all() or not np.isfinite(coc_px).all():
        raise InputError("tilt-shift needs finite colours and diameters, but some are inf or NaN: draw a diameter for every pixel")
    if not aperture.is_plain:
        raise InputError("tilt-shift needs a plain aperture, but this one has modifiers: give it as it is seen, aperture.seen(...)")
    margin = kernel_radius_px(float(np.abs(coc_px).max()), aperture.unit_radius)
    around = ((margin, margin), (margin, margin))
    values = np.dstack([rgb, np.ones_like(coc_px)])
    wide = np.pad(values, (*around, (0, 0)), mode="symmetric"), np.pad(coc_px, around, mode="symmetric")
    spread = LowRankFilter(relative_error=0.0, max_rank=rank, threads=threads).sum_kernels(*wide, aperture)
    inside = spread[margin : margin + coc_px.shape[0], margin : margin + coc_px.shape[1]]
    return inside[..., :3] / np.maximum(inside[..., 3:], np.float32(_LEAST_COVERAGE))
