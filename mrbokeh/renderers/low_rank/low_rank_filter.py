"""Low-rank filters: every pixel's PSF as a sum of few separable kernels (McGraw, Fast Bokeh Effects Using Low-Rank Linear Filters).

The blur of a picture changes from pixel to pixel, and a separable filter whose width changes between its two passes is
not the blur that was asked for (McGraw therefore goes back to 2D filtering near depth edges; see mrbokeh.renderers.low_rank.per_pixel).
Here the pixels are sorted by diameter instead: each gives its light to the two tabulated kernels next to its own, and all
light of one kernel is an even, truly separable scatter. Edges of depth need no mask then, and no light is lost or doubled.

What it costs: the light of a pixel is not exactly its PSF. The low-rank sum ripples within the square around the kernel
(in the corners too, where the kernel has ended) with a norm of `relative_error` of the kernel's, and blending two kernels
adds up to 3 % to that. Ripples average out over an even field (exactly), a texture and even an edge: an edge from 0 to 1 is
within 0.003 of its exact blur at the default. They do not average out for highlights: those are summed by their exact kernels,
see mrbokeh.renderers.low_rank.exact_scatter. Beside a bright area that just fails to count as one, the dark is off by a tenth of its
own light.

`tilt_shift` blurs a photograph by a map that somebody drew, without any depth (McGraw, Section 4 and Fig. 14): a tilted lens keeps a
wedge of space sharp, and a gradient of blur drawn over a photograph looks alike and makes the subject seem small.
"""

from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from functools import cached_property, partial

import numpy as np
from jaxtyping import Bool, Float32, Float64

from mrbokeh.images.layer import Layer
from mrbokeh.layering.layering import Layering, render_layers
from mrbokeh.optics.aperture import Aperture
from mrbokeh.optics.lens import Lens
from mrbokeh.optics.psf import kernel_radius_px
from mrbokeh.optics.psf_bank import PsfBank
from mrbokeh.renderers.bank.renderers import BankRenderer, BankTerms, KernelOpening, by_low_rank
from mrbokeh.renderers.kernels.low_rank_kernel import Levels, LowRankKernel, Taps, decompose, levels_of, taps_of
from mrbokeh.renderers.low_rank.exact_scatter import LEAST_RADIUS_PX, exact_share, scatter_exactly
from mrbokeh.renderers.low_rank.per_pixel import depth_edge_mask, scatter_per_pixel
from mrbokeh.system.errors import InputError
from mrbokeh.system.resources import cores

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
    from mrbokeh.renderers.low_rank._filter_numba import TILE_FLOATS, scatter_piece

    spans = level_spans(levels.level, levels.upper, TILE_FLOATS // values.shape[2])
    height, tiles = spans.shape[:2]
    source = (values, shares, levels.level, levels.upper, spans)
    kernels = (taps.columns, taps.rows, taps.ranks, taps.radii_px)

    def run(piece: tuple[int, int]) -> None:
        top, first = piece
        scatter_piece(out, *source, *kernels, top, min(height, top + _PIECE_ROWS), first, min(tiles, first + _PIECE_TILES))

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
