"""Laplacian spreadlets: few points of the Laplacian of every pixel's PSF, splatted, and one integration (Leimkuehler et al. 2018).

What is exact: the Laplacian that makes the points and the integration that undoes them are inverse to rounding, so the points
of whole Laplacians (`sparsification=None`) give what splatting all taps gives. Sparse points are off by about a tenth of a
kernel's norm along its outline, which averages out over the pixels of a picture, but not for a lamp or a lone pixel: those
get whole Laplacians. Light and centroid of every kernel are exact. Circles of confusion are rounded: to 1/32 px on the
fast track, to 1.1 % (64 steps per octave) beyond it. Measured (tests/bench/bench_laplacian_spreadlets.py) at a mean circle
of 40 px: SSIM 0.998 and 55 dB to dense splatting of the same kernels, 56 dB to exact ones.

A rounding error of one pixel shows, integrated, all over the picture, and those of an even area all go the same way. So Laplacians
are summed in whole numbers of 32 bits (`mrbokeh.renderers.spreadlets.sums`), of which every pixel adds 0 in all, rounded by
dithers that spread evenly; modes are kept and solved in single precision. Highlights, pixels that outshine the mean 32 times, are
splatted tap by tap instead, which keeps the whole numbers fine; at most 1/32 of the pixels can do so in one channel, so their taps cost
little. Measured: within 7e-6 of double precision, as a share of the mean, at 960 x 540 and 1e-5 at 1400 x 1400. Whole Laplacians,
pyramids and light that is not finite take double precision.

Light field samples are reconstructed too: each sample's PSF is put around the point that it saw (Leimkuehler et al. 2018, Section 6.2).
A sample at y is one ray of a point whose light is spread all over its circle of confusion and its path. Splatting the PSF at y
would apply it twice; around y' = y - coc/2 uv - motion (t - 1/2) it is put where it belongs (Fig. 7). Samples are taken in
slices of the circle of confusion, front first: each takes what is still free of a pixel, at most its coverage, that is its
weight over the samples per pixel; what remains open in the end is shared out.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, fields
from functools import partial
from typing import NamedTuple, Protocol, runtime_checkable

import numpy as np
from jaxtyping import Bool, Float32, Float64, Int

from mrbokeh.images.layer import Layer
from mrbokeh.layering.layering import Layering, render_layers
from mrbokeh.layering.light_field_samples import LightFieldSamples
from mrbokeh.layering.motion import drawn_out
from mrbokeh.layering.psf_over_field import Frame, blur_colours
from mrbokeh.optics.aperture import Aperture
from mrbokeh.optics.lens import Lens
from mrbokeh.optics.psf_bank import PsfBank
from mrbokeh.renderers.bank.bank_psf import BankPsf
from mrbokeh.renderers.bank.tables import BankTables, Place
from mrbokeh.renderers.kernels.laplacian_tables import DENSE, KernelTables, Points, kind_of, stands_out, used_codes
from mrbokeh.renderers.kernels.spreadlets import UNRELAXED, Sparsification, Spreadlets
from mrbokeh.renderers.spreadlets.sums import add_light
from mrbokeh.system.errors import InputError
from mrbokeh.system.resources import ZeroedMemory, workers

_LEAST_STEP_PX, _NOTHING_TAKEN = 0.5, 1e-6

Plane = Float32[np.ndarray, "height width"]
Channels = Float32[np.ndarray, "height width channels"]


@runtime_checkable
class _Renderer(Protocol):
    @property
    def layering(self) -> Layering: ...
    @property
    def bank(self) -> object: ...
    def sum_kernels(self, values: Channels, coc_px: Plane, aperture: Aperture) -> Channels: ...
    def sum_bank_kernels(self, values: Channels, coc_px: Plane, place: Place) -> Channels: ...


def reconstructed(samples: LightFieldSamples, lens: Lens, renderer: _Renderer) -> Layer:
    """Return an opaque picture; its depth is that of the nearest sample in each pixel."""
    coc_px, at_px = samples.coc_px(lens), samples.positions_at_lens_centre_px(lens)
    step_px = max(float(np.ptp(coc_px)) / renderer.layering.slices, _LEAST_STEP_PX)
    index = np.floor(coc_px / step_px + 0.5).astype(np.int64)
    margin = int(np.ceil(max(0.0, -at_px.min(), (at_px - (samples.width_px, samples.height_px)).max()))) + 1
    margin += int(np.ceil(0.5 * np.abs(samples.motion_px).max()))
    size = samples.height_px, samples.width_px
    colour, taken = np.zeros((*size, 3), np.float32), np.zeros((*size, 1), np.float32)
    inside = np.s_[margin : margin + samples.height_px, margin : margin + samples.width_px]
    for each in np.unique(index):
        rounds = _rounds(samples, coc_px, at_px, index == each, margin)
        light = np.sum([_blur_round(*piece, samples, lens, renderer, margin)[inside] for piece in rounds], axis=0)
        weight = np.maximum(light[..., 3:], 0.0)  # one for all colours, or one for each
        share = np.minimum(weight / np.float32(samples.per_pixel), 1.0 - taken)
        colour += share * light[..., :3] / np.maximum(weight, _NOTHING_TAKEN)
        taken = taken + share
    rgb = np.maximum(colour / np.maximum(taken, _NOTHING_TAKEN), 0.0).astype(np.float32)
    return Layer(rgb, np.ones(size, np.float32), _nearest_m(samples))


def _rounds(
    samples: LightFieldSamples, coc_px: Float32[np.ndarray, " samples"], at_px: np.ndarray, mine: Bool[np.ndarray, " samples"], margin: int
) -> Iterator[tuple[Channels, Plane, np.ndarray]]:
    """Yield R, G, B and weight, circles of confusion and motion of the first sample of every pixel, then the second, and so on."""
    chosen = np.flatnonzero(mine)
    x, y = np.floor(at_px[chosen]).astype(np.int64).T + margin
    size = samples.height_px + 2 * margin, samples.width_px + 2 * margin
    place = y * size[1] + x
    order = np.argsort(place, kind="stable")
    place, chosen = place[order], chosen[order]
    nth = np.arange(len(place)) - np.searchsorted(place, place)
    for k in range(int(nth.max()) + 1):
        where, who = np.unravel_index(place[nth == k], size), chosen[nth == k]
        values, circles, motion = np.zeros((*size, 4), np.float32), np.zeros(size, np.float32), np.zeros((*size, 2), np.float32)
        values[where] = np.concatenate([samples.rgb[who], np.ones((len(who), 1), np.float32)], axis=1)
        circles[where], motion[where] = coc_px[who], samples.motion_px[who]
        yield values, circles, motion


def _blur_round(
    values: Channels, coc_px: Plane, motion_px: np.ndarray, samples: LightFieldSamples, lens: Lens, renderer: _Renderer, margin: int
) -> np.ndarray:
    """Blur light by the aperture, drawn out along its path before, or by the kernels of the bank."""
    if renderer.bank is None:
        moving, circles = drawn_out(values, coc_px, motion_px) if motion_px.any() else (values, coc_px)
        frame = Frame(samples.width_px, samples.height_px, -margin, -margin)
        return blur_colours(renderer.sum_kernels, moving, circles, lens.aperture, frame, renderer.layering.field_cells)
    half_diagonal_px = 0.5 * np.hypot(samples.width_px, samples.height_px)
    rows, columns = np.indices(coc_px.shape) + 0.5 - margin
    field_xy = np.stack([columns - 0.5 * samples.width_px, rows - 0.5 * samples.height_px], axis=2) / half_diagonal_px
    dioptres = 1.0 / lens.focus_distance_m - coc_px / lens.coc_px_per_dioptre(samples.width_px)
    with np.errstate(divide="ignore"):
        depth_m = np.where(dioptres > 0.0, 1.0 / dioptres, np.inf)
    return renderer.sum_bank_kernels(values, coc_px, Place(motion_px, field_xy, depth_m))


def _nearest_m(samples: LightFieldSamples) -> Plane:
    x, y = samples.pixels()
    depth_m = np.full((samples.height_px, samples.width_px), np.inf, np.float32)
    np.minimum.at(depth_m, (y, x), samples.depth_m)
    return depth_m


OUTSHINES_MEAN = 32.0
_ROWS_AT_ONCE = 64
EVERY = 8  # rows whose mean stands for that of all; how many lamps there may be is no matter of a few percent

Codes = Int[np.ndarray, "height width"]
Values = Float32[np.ndarray, "height width channels"]


class Highlights(NamedTuple):
    """Mask of highlights, and the largest light, without sign, of the other pixels with sparse kernels in each channel."""

    found: Bool[np.ndarray, "height width"]
    largest: Float32[np.ndarray, " channels"]


def highlights_among(values: Values, codes: Codes, sparse: Bool[np.ndarray, " kinds"]) -> Highlights:
    """Return the highlights among pixels whose code (-1 for none) is sparse."""
    from mrbokeh.renderers.spreadlets._splat_numba import mark_highlights

    limits = (OUTSHINES_MEAN * _mean(values, codes, sparse)).astype(np.float32)
    starts = range(0, len(codes), _ROWS_AT_ONCE)
    found, largest = np.zeros(codes.shape, np.bool_), np.zeros((len(starts), values.shape[2]), np.float32)

    def find(band: int) -> None:
        rows = slice(starts[band], starts[band] + _ROWS_AT_ONCE)
        mark_highlights(found[rows], largest[band], values[rows], codes[rows], sparse, limits)

    with workers(codes.size) as pool:
        list(pool.map(find, range(len(starts))))
    return Highlights(found, largest.max(axis=0))


def _mean(values: Values, codes: Codes, sparse: Bool[np.ndarray, " kinds"]) -> Float64[np.ndarray, " channels"]:
    """Return the mean light, without sign, of the sparse pixels, in some rows or, if these have none, in all."""
    from mrbokeh.renderers.spreadlets._splat_numba import add_up

    sums = np.zeros(values.shape[2])
    for step in (EVERY, 1):
        count = add_up(sums, values[::step], codes[::step], sparse)
        if count:
            return sums / count
    return sums


_MOST_KEPT_BYTES = 1 << 27


@dataclass(frozen=True)
class LaplacianSpreadlets:
    """Renderer that sums spreadlets; layers, slices and hidden background as in mrbokeh.layering.layering.

    sparsification: how kernels become points; None takes the whole Laplacian (exact, in double precision throughout).
    dense_up_to_px: the fast track: kernels of apertures up to this diameter are splatted as they are; those of a bank with
    as few taps as a disc of 24 px. integration: "exact" or "pyramid", see kernels.laplacian_integration. threads: 0 takes all.
    bank: kernels to use instead of the lens's aperture; spreadlets: its own, if they have been computed before. device: where
    light is summed, "" by compiled loops, "cuda", "cuda:1" or "cpu" by torch (mrbokeh.renderers.spreadlets.torch_spreadlets).
    """

    bank: PsfBank | None = None
    layering: Layering = field(default_factory=Layering)
    threads: int = 0
    integration: str = "exact"
    sparsification: Sparsification | None = UNRELAXED
    dense_up_to_px: float = 24.0
    spreadlets: Spreadlets | None = field(default=None, repr=False)
    device: str = ""
    _add_light: Callable[..., None] = field(init=False, repr=False, compare=False)
    _tables: KernelTables = field(init=False, repr=False, compare=False)
    _bank_tables: BankTables | None = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        if self.integration not in ("exact", "pyramid"):
            raise InputError(f"a Laplacian is integrated by 'exact' or 'pyramid', got {self.integration!r}")
        if not self.dense_up_to_px >= 2.0:
            raise InputError(f"kernels up to at least 2 px are splatted as they are, got dense_up_to_px {self.dense_up_to_px}")
        bank_tables = None if self.bank is None else BankTables(self.bank, self.sparsification, self.spreadlets)
        object.__setattr__(self, "_tables", KernelTables(self.dense_up_to_px, self.sparsification))
        object.__setattr__(self, "_bank_tables", bank_tables)
        object.__setattr__(self, "_add_light", _adder_on(self.device))

    def __reduce__(self) -> tuple[Callable[[], "LaplacianSpreadlets"], tuple[()]]:
        """Make it anew where it is unpickled: memory and tables stay here."""
        return partial(type(self), **{each.name: getattr(self, each.name) for each in fields(self) if each.init}), ()

    def render(self, layers: Sequence[Layer], lens: Lens) -> Layer:
        if self._bank_tables is None or not layers:
            return render_layers(layers, lens, self.sum_kernels, self.layering)
        return render_layers(layers, lens, BankPsf.of(layers, lens, self._bank_tables, self.sum_bank_kernels), self.layering)

    def reconstruct(self, samples: LightFieldSamples, lens: Lens) -> Layer:
        """Reconstruct a picture from noisy samples: each gives its light to the whole PSF of the point that it saw (Section 6.2, Fig.
        7).
        """
        return reconstructed(samples, lens, self)

    def sum_kernels(
        self,
        values: Float32[np.ndarray, "height width channels"],
        coc_px: Float32[np.ndarray, "height width"],
        aperture: Aperture,
        densely: bool = False,
    ) -> Float32[np.ndarray, "height width channels"]:
        """Sum kernels as mrbokeh.layering.psf_over_field.KernelSum says. densely: all taps of the same kernels, without a Laplacian."""
        sharp = np.zeros_like(values)
        codes = self._tables.codes(sharp, values, coc_px, aperture)
        kinds = {int(code): densely or kind_of(int(code)) == DENSE for code in used_codes(codes)}
        self._add_summed(sharp, values, codes, kinds, lambda some, dense: self._tables.points(some, aperture, self.threads, dense))
        return sharp

    def sum_bank_kernels(
        self,
        values: Float32[np.ndarray, "height width channels"],
        coc_px: Float32[np.ndarray, "height width"],
        place: Place,
        densely: bool = False,
    ) -> Float32[np.ndarray, "height width channels_out"]:
        """Return the sum over all pixels of value times the bank's kernel: R, G, B, coverage, then others, as in
        layering.psf_over_field.PsfField.

        Coverage, three times for a bank of three colours, and others take kernels scaled to sum to 1: light that is absorbed darkens what
        is seen, but is no hole in it. Others go with green. What a bank of one colour is given may also be colour alone, of up to three
        channels. Circles of confusion and the border as in mrbokeh.layering.psf_over_field.KernelSum. densely: all taps of the same
        kernels.
        """
        tables = self._bank_tables
        if tables is None:
            raise InputError("this renderer was made without a bank: give it one")
        lit = np.any(values != 0, axis=-1)
        if not np.isfinite(coc_px[lit]).all():
            raise InputError("every visible pixel needs a finite circle of confusion: depth must be positive (or inf), not 0 or NaN")
        codes = np.where(lit, tables.codes(np.where(lit, coc_px, np.float32(0)), stands_out(values), place), -1)
        kinds = {int(code): densely or tables.is_dense(int(code)) for code in used_codes(codes)}

        def summed(colours: list[int], others: list[int], channel: int) -> np.ndarray:
            picked = np.ascontiguousarray(values[..., [*colours, *others]])
            picked[..., len(colours) :] /= tables.light(codes)[..., channel : channel + 1]
            out = np.zeros_like(picked)
            self._add_summed(out, picked, codes, kinds, partial(tables.points, channel=channel))
            return out

        others = list(range(3, values.shape[2]))
        if tables.bank.channels == 1:
            return summed([0, 1, 2][: values.shape[2]], others, 0)
        each = [summed([c], others if c == 1 else [3], c) for c in range(3)]
        return np.concatenate([*(light[..., :1] for light in each), *(light[..., 1:2] for light in each), each[1][..., 2:]], axis=2)

    def _add_summed(
        self,
        out: Float32[np.ndarray, "height width channels"],
        values: Float32[np.ndarray, "height width channels"],
        codes: Int[np.ndarray, "height width"],
        kinds: dict[int, bool],
        points_of: Callable[[Sequence[int], bool], Points],
    ) -> None:
        """Add the light of all pixels with a code, those whose kind is dense (True) by all taps, the others by Laplacians."""
        base, largest = max(kinds, default=0) + 1, None
        sparse = np.zeros(base, np.bool_)
        sparse[[code for code, dense in kinds.items() if not dense]] = True
        if self._sums_whole_numbers and sparse.any():
            found, largest = highlights_among(values, codes, sparse)
            where = np.nonzero(found)
            if where[0].size:
                codes = codes.copy()
                codes[where] += base
                kinds = kinds | {int(code): True for code in np.unique(codes[where])}
        used, parts = np.array(sorted(kinds), np.int64), {}
        for dense in (True, False):
            mine = used[[kinds[int(code)] is dense for code in used]]
            if mine.size:
                cell_of = np.full(2 * base + 1, -1, np.int32)  # its last entry is that of code -1
                cell_of[mine] = np.arange(mine.size)
                parts[dense] = cell_of[codes], points_of((mine % base).tolist(), dense)
        if largest is not None:
            self._add_light(out, values, *parts[False], self.integration, self.threads, largest=largest, taps=parts.get(True))
            return
        for dense, (cells, points) in parts.items():
            self._add_light(out, values, cells, points, None if dense else self.integration, self.threads)

    @property
    def _sums_whole_numbers(self) -> bool:
        """Whether sums are whole numbers of 32 bits, for which highlights are set apart; other sums hold any light."""
        return not self.device and self.sparsification is not None and self.integration == "exact"


def _adder_on(device: str) -> Callable[..., None]:
    if not device:
        return partial(add_light, memory=ZeroedMemory(most_bytes=_MOST_KEPT_BYTES))
    from mrbokeh.renderers.spreadlets.torch_spreadlets._sums import add_light_on

    return add_light_on(device)
