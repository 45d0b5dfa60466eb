"""Polygonal directional differences: a blur whose cost does not grow with its size (Moroto, Hachisuka, Umetani, 2021).

The aperture is rectified to polygons along few directions. Every pixel throws the impulses of its kernel's corners into
buffers, one per pair of directions that meet in a corner; sums along the directions and then downwards turn impulses into
light (mrbokeh.renderers.polygon.directional_differences). Pixels come row by row and rows are summed as soon as they are complete, so that
only as many rows as the largest kernel is high are held.

Beyond the paper:
- Weighted sums of polygons: every outline adds its corners, with its weight.
- Any diameter, without steps: corners lie between lattice points and are split among the four around them. No table of
  kernels by radius is needed. Light is exact, symmetric kernels stay in place, and the size of the blur is right on average.
- High dynamic range: impulses in single precision are off by up to 1e-6 of the strongest light in the picture, anywhere in
  it. They are used in larger pictures where that is below 1e-4 of the darkest tile, else double precision, which is off by about 1e-10.
  Measured with lights of 1e5 over 0.1: 0.17 of the local signal in single, 2e-7 (the rounding of the result) in double.
- Small kernels are splatted whole, by the true aperture: below `exact_below_px` they are cheaper and sharper so.
- What is far out of focus is blurred at half the resolution, the blurriest of it at half of that, and so on
  (mrbokeh.renderers.polygon.surveyed_light): such light is smooth, so its kernel's rim may be a cell softer. Centres and light stay.
- Highlights are splatted whole too: a pixel that gives more than 5 % of the light in the square of four radii around it shows
  its kernel, corners and all, and there can be but few of those. The share spread so rises smoothly from 5 to 10 %.
- Layers and occlusion: mrbokeh.layering.layering.

How near to exact kernels of the true aperture: a texture of noise in [0, 1] under noisy diameters of 0 to 30 px comes within
58 dB for an octagon, 61 for a disc, 59 for 7 blades, 57 for a ring, 52 for a heart; a kernel's rim is off by up to 0.16 of a
pixel. In single precision pixels in focus that share a picture with blurred ones are off by up to 1e-7. Halving costs little
beside that: under 0 to 400 px both ways agree to 68 dB.

What it costs (tests/bench/bench_polygon_differences.py): per corner and pixel four splats of four channels, neighbouring ones together,
then the sums. Larger kernels cost no more: what they need at the halved resolutions, and what is kept of the rest, is less work.

Work is divided into bands of rows, each with the memory of the thread that runs it.
"""

from collections.abc import Sequence
from concurrent.futures import Executor
from dataclasses import dataclass, field
from functools import cached_property
from itertools import pairwise
from threading import Lock
from typing import TYPE_CHECKING, Literal
from weakref import WeakKeyDictionary

import numpy as np
from jaxtyping import Bool, Float32, Int64

from mrbokeh.images.layer import Layer
from mrbokeh.layering.layering import Layering, render_layers
from mrbokeh.optics.aperture import Aperture
from mrbokeh.optics.lens import Lens
from mrbokeh.optics.psf_bank import PsfBank
from mrbokeh.renderers.kernels._vectors_numba import CHUNK_PX
from mrbokeh.renderers.polygon._differences_numba import settle, splat_parts
from mrbokeh.renderers.polygon._ring_numba import ALIASED_ROWS, BLOCK_ROWS, GUARD, Corners, Picture, Ring, Scratch, Target, lay_out
from mrbokeh.renderers.polygon._survey_numba import TILE_PX, find_parts
from mrbokeh.renderers.polygon.directional_differences import Direction
from mrbokeh.renderers.polygon.rectification import PAPER_DIRECTIONS
from mrbokeh.renderers.polygon.surveyed_light import NO_HIGHLIGHTS, SurveyedLight, halves_of
from mrbokeh.renderers.polygon.tables import ApertureTables, tables_of
from mrbokeh.system.errors import InputError
from mrbokeh.system.resources import ZeroedMemory, cores, workers

if TYPE_CHECKING:
    from mrbokeh.renderers.bank.apertures import BankApertures
    from mrbokeh.renderers.bank.renderers import BankRenderer
    from mrbokeh.renderers.polygon.torch_polygon import TorchPolygons


def ring_of(tables: ApertureTables, margin: int, width: int, planes: np.ndarray) -> Ring:
    """Return a ring for parts of a picture of at most this width, in `planes`: at least `ring_elements` zeros."""
    rows, stride = 2 * margin + BLOCK_ROWS, width + 2 * margin
    return Ring(
        planes=planes,
        plane_elements=(rows + 2 * ALIASED_ROWS) * stride * 4,
        light_plane=len(tables.planes),
        rows=rows,
        stride=stride,
        margin=margin,
        left=0,
    )


def ring_elements(tables: ApertureTables, margin: int, width: int) -> int:
    return (len(tables.planes) + 1) * (2 * margin + BLOCK_ROWS + 2 * ALIASED_ROWS) * (width + 2 * margin) * 4


def laid_out(tables: ApertureTables, ring: Ring) -> Corners:
    """Return the corners with steps and places for this ring."""
    crossed, count = tables.crossed, len(tables.crossed.plane)
    step, place, plane, below = (np.empty(shape, np.int64) for shape in ((count, 2), (count, 4), count, count))
    lay_out(crossed.steps, crossed.places, crossed.turned, crossed.plane, (ring.stride, ring.plane_elements), (step, place, plane, below))
    return tables.corners_in(ring.planes.dtype)._replace(step=step, place=place, plane=plane, below=below)


def scratch_of(tables: ApertureTables, ring: Ring) -> Scratch:
    edges, corners = len(tables.corners.slope), len(tables.corners.weight)
    dtype = ring.planes.dtype
    return Scratch(
        element=np.zeros(CHUNK_PX, np.int32),
        radius=np.zeros(CHUNK_PX, dtype),
        gain=np.zeros(2 * CHUNK_PX, dtype),
        line=np.zeros(edges * CHUNK_PX, np.int32),
        share=np.zeros(edges * CHUNK_PX, dtype),
        target=np.zeros((corners + 1) * CHUNK_PX, np.int32),
        weight=np.zeros(4 * corners * CHUNK_PX, dtype),
        sums=np.zeros((int(tables.sums.row_start[-1]), 4 * ring.stride + 2 * GUARD)),
        total=np.zeros(4 * ring.stride),
        carry=np.zeros(4),
        small=np.zeros(CHUNK_PX, np.int32),
        small_share=np.zeros(CHUNK_PX, np.float32),
        rows=np.zeros(2 * tables.exact.radius + 1, np.int64),
        taps=np.zeros(2 * ring.margin + 1, dtype),
        kernel=np.zeros((2, (2 * ring.margin + 1) ** 2)),
    )


BAND_ROWS = 384
"""Least height of a band; two margins where these are larger. Bands do not depend on the number of threads."""
RING_BYTES = 6 << 20
"""A band is worked through in parts so narrow that the ring fits the cache, but not narrower than four margins."""
SETTLED_ROWS = 128
"""Rows that are completed together when all bands are done."""
FEW_PIXELS = 1 << 18
"""Pictures below this size are one band."""
SPARSE, SPARSE_PART_PX = 0.5, 96
"""Where less than this share of the tiles holds light, parts are narrow, so that they leave out what is dark."""
_LEAST_ROWS = 64


@dataclass(frozen=True)
class Band:
    """Rows top..bottom of a picture, and its parts of equal width that hold light, each first row, end row, left, right."""

    top: int
    bottom: int
    parts: Int64[np.ndarray, "parts 4"]


def bands_of(light: SurveyedLight, margin: int, bytes_per_cell: int) -> list[Band]:
    (height, width), tiles = light.coc_px.shape, light.tiles
    first, end = tiles.first * TILE_PX, min(tiles.end * TILE_PX, height)
    least = _LEAST_ROWS if height * width > FEW_PIXELS else height
    count = max((end - first) // max(BAND_ROWS, 2 * margin), min(2, (end - first) // least), 1)
    cuts = [first + round(k * (end - first) / TILE_PX / count) * TILE_PX for k in range(count)]
    sparse = tiles.lit < SPARSE * tiles.occupied.size
    step = max(SPARSE_PART_PX, 2 * margin) if sparse else _part_width(width, margin, bytes_per_cell)
    return [Band(top, bottom, parts_of(tiles.occupied, top, bottom, width, step, margin)) for top, bottom in pairwise([*cuts, end])]


def _part_width(width: int, margin: int, bytes_per_cell: int) -> int:
    fitting = RING_BYTES // (2 * margin * bytes_per_cell) - 2 * margin
    return -(-width // max(1, round(width / max(fitting, 4 * margin, 256))))


def parts_of(
    occupied: Bool[np.ndarray, "rows columns"], top: int, bottom: int, width: int, step: int, margin: int
) -> Int64[np.ndarray, "parts 4"]:
    """Return parts column by column, `step` px wide; within a column parts are separate if light of one does not reach the other."""
    first, end = top // TILE_PX, -(-bottom // TILE_PX)
    parts = np.empty((-(-width // step) * (end - first), 4), np.int64)
    return parts[: find_parts(occupied, (top, bottom), width, step, margin, parts)]


@dataclass(frozen=True)
class BandRunner:
    """Runner of the bands of all pictures of a call. halve_from_px: see mrbokeh.renderers.polygon.surveyed_light; inf for never."""

    tables: ApertureTables
    dtype: type
    pool: Executor
    threads: int
    memory: ZeroedMemory
    halve_from_px: float

    def sum_resolutions(self, light: SurveyedLight, highlights: Float32[np.ndarray, "_ _"]) -> Float32[np.ndarray, "height width 4"]:
        """Sum the kernels of a picture of four channels, the blurriest parts at half the resolution, and of those the blurriest at
        half of that.
        """
        halves = halves_of(light, highlights, self.halve_from_px, self.pool)
        half = np.zeros((0, 0), np.float32)
        if halves.half is not None:
            half = self.sum_resolutions(halves.half, NO_HIGHLIGHTS)
            half = half.reshape(len(half), -1)
        return self._sum_bands(halves.kept, highlights, halves.share, half)

    def _sum_bands(
        self,
        light: SurveyedLight,
        highlights: Float32[np.ndarray, "_ _"],
        halved: Float32[np.ndarray, "_ _"],
        half: Float32[np.ndarray, "_ _"],
    ) -> Float32[np.ndarray, "height width 4"]:
        """Sum bands one by one, by as many threads as there are; light that leaves its band is added in the order of the bands."""
        out = np.zeros(light.values.shape, np.float32)
        flat, nonnegative = out.reshape(len(out), -1), light.least >= 0.0
        bands, margin = [], 0
        if light.tiles.lit:
            margin = self.tables.margin_px(light.tiles.largest_px)
            bands = bands_of(light, margin, (len(self.tables.planes) + 1) * 4 * np.dtype(self.dtype).itemsize)
        edges = [(band.top, band.bottom) for band in bands] if len(bands) > 1 else [(0, len(out))]
        strays = np.zeros((len(edges), 2, margin if len(bands) > 1 else 0, flat.shape[1]), np.float32)
        targets = [Target(flat, above, below, *rows) for (above, below), rows in zip(strays, edges, strict=True)]
        picture = Picture(
            values=light.values,
            coc_px=light.coc_px,
            share=highlights,
            halved=halved,
            nonnegative=nonnegative,
            largest_px=light.largest_of_tile_px,
        )
        waiting, lock = zip(bands, targets, strict=False), Lock()
        width = max((int((band.parts[:, 3] - band.parts[:, 2]).max(initial=0)) for band in bands), default=0)
        tables = self.tables

        def work() -> None:
            planes = self.memory.take(ring_elements(tables, margin, width), self.dtype)
            ring = ring_of(tables, margin, width, planes)
            corners, scratch = laid_out(tables, ring), scratch_of(tables, ring)
            while True:
                with lock:
                    piece = next(waiting, None)
                if piece is None:
                    break
                band, target = piece
                splat_parts(picture, corners, tables.sums, tables.exact, ring, scratch, target, band.parts)
            self.memory.give_back(planes)

        list(self.pool.map(lambda _: work(), range(min(self.threads, len(bands)))))
        starts = np.array([[top - margin, bottom] for top, bottom in edges]).reshape(-1)
        pieces = strays.reshape(2 * len(edges), *strays.shape[2:])

        def finish(top: int) -> None:
            target = Target(out=flat, above=strays[0, 0], below=strays[0, 1], top=top, bottom=min(top + SETTLED_ROWS, len(out)))
            settle(target, pieces, starts, half, np.empty(half.shape[1], np.float32), nonnegative)

        list(self.pool.map(finish, range(0, len(out), SETTLED_ROWS)))
        return out


_SINGLE_PRECISION = 50.0
"""Where the strongest light is at most so many times that of the darkest tile, single precision is 1e-4 of the local signal in a
picture of 2 megapixels; rounding adds up as the root of their number."""

_SMALL_PX = 2.5e5
"""Smaller pictures always take double precision, so that a first one compiles its loops once and not twice. At 720p it would cost 44 %."""


@dataclass(frozen=True)
class PolygonDifferences:
    """Renderer that sums kernels by polygonal differences; layers, slices and hidden background as in mrbokeh.layering.layering.

    directions, max_edges: of the rectified polygons; an aperture that fits them already is taken as it is.
    exact_below_px: diameters up to this are splatted whole, those above 7/6 of it through the sums, those between by both. None takes what
      suits the aperture, 8 to 16 px: the diameter at which its shortest edge is 3/4 of a lattice step.
    exact_highlights: False also takes highlights through the sums, which is strictly linear (else light scaled as a whole gives the scaled
      result, but two pictures blurred separately add up to their sum only as near as rectified kernels come).
    halve_from_px: diameters up to this are blurred at full resolution, those above 9/8 of it at half of it or less, those between by both;
      inf for never. Pixels beside others of quite another diameter are never halved, nor is a picture of which less than a quarter is so
      blurred.
    precision: of the impulses, "auto" for the choice above; "single" and "double" force it.
    threads: 0 takes all cores. The result does not depend on it, bit for bit.
    device: "" for compiled loops on the CPU; "cuda", "cuda:1" or "cpu" for torch there (mrbokeh.renderers.polygon.torch_polygon), with
      impulses in double precision unless "single" is asked for, and no halved resolution.
    bank: kernels to use instead of the lens's aperture, as polygons fitted to them (blur of up to 1 px stays sharp); apertures: those, if
      they have been fitted before.
    Memory for the rows is kept between calls.
    """

    directions: tuple[Direction, ...] = PAPER_DIRECTIONS
    max_edges: int = 16
    exact_below_px: float | None = None
    exact_highlights: bool = True
    halve_from_px: float = 112.0
    precision: Literal["auto", "single", "double"] = "auto"
    layering: Layering = field(default_factory=Layering)
    threads: int = 0
    device: str = ""
    bank: PsfBank | None = None
    apertures: "BankApertures | None" = field(default=None, repr=False)
    _memory: ZeroedMemory = field(default_factory=ZeroedMemory, repr=False, compare=False)
    _tables: WeakKeyDictionary[Aperture, ApertureTables] = field(default_factory=WeakKeyDictionary, repr=False, compare=False)

    def __post_init__(self) -> None:
        if self.exact_below_px is not None and not self.exact_below_px >= 2.0:
            raise InputError(f"exact_below_px must be at least 2 px, where polygons have no inside yet, got {self.exact_below_px}")
        if not self.halve_from_px >= 32.0:
            raise InputError(f"halve_from_px must be at least 32 px, so that kernels keep their shape, got {self.halve_from_px}")
        if self.precision not in ("auto", "single", "double"):
            raise InputError(f"precision must be auto, single or double, got {self.precision!r}")
        _ = self._by_torch  # a device that is not there is refused at once

    def render(self, layers: Sequence[Layer], lens: Lens) -> Layer:
        if self._by_torch is not None and self.bank is None and self._by_torch.takes(layers, lens, self.layering):
            return self._by_torch.render_layer(layers[0], lens, self.layering.slices)
        if self._of_bank is None or not layers:
            return render_layers(layers, lens, self.sum_kernels, self.layering)
        return self._of_bank.render(layers, lens, self.layering)

    @cached_property
    def _by_torch(self) -> "TorchPolygons | None":
        if not self.device:
            return None
        from mrbokeh.renderers.polygon.torch_polygon import TorchPolygons

        rectified = self.directions, self.max_edges, self.exact_below_px
        return TorchPolygons(self.device, *rectified, self.exact_highlights, "single" if self.precision == "single" else "double")

    @cached_property
    def _of_bank(self) -> "BankRenderer | None":
        if self.bank is None:
            return None
        from mrbokeh.renderers.bank.apertures import fit_apertures
        from mrbokeh.renderers.bank.lattice import BankLattice
        from mrbokeh.renderers.bank.renderers import by_polygons

        prepare = self.tables_of if self._by_torch is None else self._by_torch.tables_of
        return by_polygons(self.bank, self.apertures or fit_apertures(BankLattice(self.bank)), self.sum_kernels, prepare)

    def sum_kernels(
        self, values: Float32[np.ndarray, "height width channels"], coc_px: Float32[np.ndarray, "height width"], aperture: Aperture
    ) -> Float32[np.ndarray, "height width channels"]:
        """Sum kernels as mrbokeh.layering.psf_over_field.KernelSum says."""
        if self._by_torch is not None:
            return self._by_torch.sum_arrays(values, coc_px, aperture)
        threads = self.threads or cores()
        with workers(coc_px.size, threads) as pool:
            light = SurveyedLight.of(values, coc_px, pool)
            if light.tiles.largest_px <= 1.0:
                return values.copy()
            tables = self.tables_of(aperture)
            share = light.highlights(tables.exact.from_px, pool) if self.exact_highlights else NO_HIGHLIGHTS
            double = self.precision == "double" or (
                self.precision == "auto"
                and (light.pixels < _SMALL_PX or light.tiles.contrast * light.pixels**0.5 > _SINGLE_PRECISION * 2e6**0.5)
            )
            dtype = np.float64 if double else np.float32
            runner = BandRunner(
                tables=tables, dtype=dtype, pool=pool, threads=threads, memory=self._memory, halve_from_px=self.halve_from_px
            )
            spreads = [runner.sum_resolutions(light.group(first), share) for first in range(0, values.shape[2], 4)]
        return spreads[0] if values.shape[2] == 4 else np.ascontiguousarray(np.concatenate(spreads, axis=2)[..., : values.shape[2]])

    def tables_of(self, aperture: Aperture) -> ApertureTables:
        """Return the tables of an aperture, computed once and kept as long as it lives."""
        tables = self._tables.get(aperture)
        if tables is None:
            tables = self._tables[aperture] = tables_of(aperture, self.directions, self.max_edges, self.exact_below_px)
        return tables
