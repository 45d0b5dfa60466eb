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
  it. They are used where that is below 1e-4 of the darkest tile, else double precision, which is off by about 1e-10.
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
"""

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import TYPE_CHECKING, Literal
from weakref import WeakKeyDictionary

import numpy as np
from jaxtyping import Float32

from mrbokeh.images.layer import Layer
from mrbokeh.layering.layering import Layering, render_layers
from mrbokeh.optics.aperture import Aperture
from mrbokeh.optics.lens import Lens
from mrbokeh.optics.psf_bank import PsfBank
from mrbokeh.renderers.bank.apertures import BankApertures, fit_apertures
from mrbokeh.renderers.bank.lattice import BankLattice
from mrbokeh.renderers.bank.renderers import BankRenderer, by_polygons
from mrbokeh.renderers.polygon.directional_differences import Direction
from mrbokeh.renderers.polygon.rectification import PAPER_DIRECTIONS
from mrbokeh.system.errors import InputError
from mrbokeh.system.resources import ZeroedMemory, cores, workers

if TYPE_CHECKING:
    from mrbokeh.renderers.polygon.tables import ApertureTables

_SINGLE_PRECISION = 50.0
"""Where the strongest light is at most so many times that of the darkest tile, single precision is 1e-4 of the local signal in a
picture of 2 megapixels; rounding adds up as the root of their number."""


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
    bank: PsfBank | None = None
    apertures: BankApertures | None = field(default=None, repr=False)
    _memory: ZeroedMemory = field(default_factory=ZeroedMemory, repr=False, compare=False)
    _tables: "WeakKeyDictionary[Aperture, ApertureTables]" = field(default_factory=WeakKeyDictionary, repr=False, compare=False)

    def __post_init__(self) -> None:
        if self.exact_below_px is not None and not self.exact_below_px >= 2.0:
            raise InputError(f"exact_below_px must be at least 2 px, where polygons have no inside yet, got {self.exact_below_px}")
        if not self.halve_from_px >= 32.0:
            raise InputError(f"halve_from_px must be at least 32 px, so that kernels keep their shape, got {self.halve_from_px}")
        if self.precision not in ("auto", "single", "double"):
            raise InputError(f"precision must be auto, single or double, got {self.precision!r}")

    def render(self, layers: Sequence[Layer], lens: Lens) -> Layer:
        if self._of_bank is None or not layers:
            return render_layers(layers, lens, self.sum_kernels, self.layering)
        return self._of_bank.render(layers, lens, self.layering)

    @cached_property
    def _of_bank(self) -> BankRenderer | None:
        if self.bank is None:
            return None
        return by_polygons(self.bank, self.apertures or fit_apertures(BankLattice(self.bank)), self.sum_kernels, self.tables_of)

    def sum_kernels(
        self, values: Float32[np.ndarray, "height width channels"], coc_px: Float32[np.ndarray, "height width"], aperture: Aperture
    ) -> Float32[np.ndarray, "height width channels"]:
        """Sum kernels as mrbokeh.layering.psf_over_field.KernelSum says."""
        from mrbokeh.renderers.polygon.bands import BandRunner
        from mrbokeh.renderers.polygon.surveyed_light import NO_HIGHLIGHTS, SurveyedLight

        threads = self.threads or cores()
        with workers(coc_px.size, threads) as pool:
            light = SurveyedLight.of(values, coc_px, pool)
            if light.tiles.largest_px <= 1.0:
                return values.copy()
            tables = self.tables_of(aperture)
            share = light.highlights(tables.exact.from_px, pool) if self.exact_highlights else NO_HIGHLIGHTS
            double = self.precision == "double" or (
                self.precision == "auto" and light.tiles.contrast * light.pixels**0.5 > _SINGLE_PRECISION * 2e6**0.5
            )
            dtype = np.float64 if double else np.float32
            runner = BandRunner(
                tables=tables, dtype=dtype, pool=pool, threads=threads, memory=self._memory, halve_from_px=self.halve_from_px
            )
            spreads = [runner.sum_resolutions(light.group(first), share) for first in range(0, values.shape[2], 4)]
        return spreads[0] if values.shape[2] == 4 else np.ascontiguousarray(np.concatenate(spreads, axis=2)[..., : values.shape[2]])

    def tables_of(self, aperture: Aperture) -> "ApertureTables":
        """Return the tables of an aperture, computed once and kept as long as it lives."""
        from mrbokeh.renderers.polygon.tables import tables_of

        tables = self._tables.get(aperture)
        if tables is None:
            tables = self._tables[aperture] = tables_of(aperture, self.directions, self.max_edges, self.exact_below_px)
        return tables
