"""Polygonal differences by torch: on an NVIDIA GPU, or on any processor that torch runs on (Moroto, Hachisuka, Umetani, 2021).

The same corners, sums and whole small kernels as the compiled loops, in another order: all impulses of a picture are thrown first, by
atomic additions, then summed along each direction and downwards, by as many threads as there are chains. Impulses are whole numbers, so
that sums do not depend on the order and one picture gives the same bits each time. Whole numbers may wrap around on the way: only what
arrives in the picture must fit. Of 32 bits ("single") a unit is some 1e-8 of the strongest light, which adds up to 2e-5 of it in 2
megapixels; of 64 bits ("double") nothing is seen of it.

Two ways in. `PolygonDifferences(device="cuda")` renders as ever and hands its sums to the device. `TorchPolygons` is for what has to be
quick: light lies on the device and stays there. Kernels of a size that the compiled loops blur at half the resolution are blurred as they
are here, for time does not grow with their size.

torch comes with the extra `train`; without it, importing this package says so.
"""

from math import floor, log2
from typing import Any, Literal, NamedTuple
from weakref import WeakKeyDictionary

try:
    import torch
except ModuleNotFoundError as missing:
    from mrbokeh.system.errors import MissingExtraError

    raise MissingExtraError("torch", "train") from missing

import numpy as np
from jaxtyping import Float32
from torch import Tensor

from mrbokeh.layering.psf_over_field import reach_px
from mrbokeh.optics.aperture import Aperture
from mrbokeh.optics.drawn_diameters import STEPS_PER_PX, drawn_table
from mrbokeh.renderers.polygon.directional_differences import Direction
from mrbokeh.renderers.polygon.rectification import PAPER_DIRECTIONS
from mrbokeh.renderers.polygon.tables import tables_of
from mrbokeh.renderers.polygon.torch_polygon import _loops
from mrbokeh.renderers.polygon.torch_polygon._corners import DeviceTables
from mrbokeh.renderers.polygon.torch_polygon._highlights import shares_of_highlights, stamp
from mrbokeh.system.errors import InputError
from mrbokeh.system.torch_device import device_named, has_triton

_BITS = {torch.int32: 31, torch.int64: 62}
_MOST_NUMBERED = 1 << 31  # kernels count in 32 bits

Picture = Float32[Tensor, "height width 4"]
Plane = Float32[Tensor, "height width"]


class Light(NamedTuple):
    """What is known of the light of a picture: between which diameters its kernels lie, the strongest value, and whether to look for
    highlights.
    """

    least_px: float
    largest_px: float
    most: float
    has_highlights: bool


class TorchPolygons:
    """Sums of polygonal kernels on a device, for light that lies there.

    device: 'cuda', 'cuda:1', 'cpu'. directions, max_edges, exact_below_px, exact_highlights: as for PolygonDifferences. precision: of the
    impulses; "single" is for pictures without deep shadows beside strong light.
    """

    def __init__(
        self,
        device: str = "cuda",
        directions: tuple[Direction, ...] = PAPER_DIRECTIONS,
        max_edges: int = 16,
        exact_below_px: float | None = None,
        exact_highlights: bool = True,
        precision: Literal["single", "double"] = "single",
    ) -> None:
        self.device = device_named(device)
        self._rectified = directions, max_edges, exact_below_px
        self._exact_highlights = exact_highlights
        self._whole = torch.int32 if precision == "single" else torch.int64
        self._tables: WeakKeyDictionary[Aperture, DeviceTables] = WeakKeyDictionary()

    def sum_kernels(self, values: Picture, coc_px: Plane, aperture: Aperture) -> Picture:
        """Return the sum over all pixels of light times kernel, of the same size; light that leaves the frame is lost.

        values (H, W, 4): linear, premultiplied. coc_px (H, W): signed diameters. aperture: plain. Waits for the device to learn the largest.
        """
        seen_px = torch.where((values != 0).any(dim=2), coc_px.abs(), 0.0)
        most, largest_px = torch.stack([values.abs().amax(), seen_px.amax()]).tolist()
        if not largest_px < np.inf:
            raise InputError("every visible pixel needs a finite circle of confusion: depth must be positive (or inf), not 0 or NaN")
        if largest_px <= 1.0:
            return values.clone()
        out = self._summed(values, coc_px, aperture, Light(0.0, largest_px, most, self._exact_highlights))
        kept = values.amin(dim=(0, 1)) >= 0.0
        return torch.where(kept, out.clamp(min=0.0), out)

    def render(self, rgb: Float32[Tensor, "height width 3"], coc_px: Plane, aperture: Aperture, slices: int = 16) -> Picture:
        """Return an opaque picture as the lens sees it, in slices: R, G, B and coverage 1. Needs a GPU with Triton.

        rgb: linear. coc_px: signed diameters of the circle of confusion. aperture: plain.
        """
        from mrbokeh.layering.torch_layering import render

        drawn_px = self._drawn_px(coc_px, aperture)
        most, largest_px = torch.stack([rgb.abs().amax(), drawn_px.abs().amax()]).tolist()
        if not largest_px < np.inf:
            raise InputError("every visible pixel needs a finite circle of confusion: depth must be positive (or inf), not 0 or NaN")
        light = torch.cat([rgb, torch.ones_like(rgb[..., :1])], dim=2)
        has_highlights = (
            self._exact_highlights and shares_of_highlights(light, drawn_px, self.tables_of(aperture).tables.exact.from_px) is not None
        )

        def blurred(values: Picture, circles: Plane, least_px: float, largest_px: float) -> Picture:
            if largest_px <= 1.0:
                return values
            return self._summed(values, circles, aperture, Light(least_px, largest_px, max(most, 1.0), has_highlights))

        return render(rgb, drawn_px, reach_px(aperture, largest_px), largest_px, slices, blurred)

    def _drawn_px(self, coc_px: Plane, aperture: Aperture) -> Plane:
        """Return `drawn_diameters_px` of a plane on the device."""
        table = torch.from_numpy(drawn_table(aperture)).to(self.device)
        last = len(table) - 1
        size = coc_px.abs()
        at = (size * STEPS_PER_PX).clamp(max=last)
        lower = at.long().clamp(max=last - 1)
        near = table[lower] + (at - lower) * (table[lower + 1] - table[lower])
        wide = torch.sqrt((size * size - (last / STEPS_PER_PX) ** 2 + table[last] ** 2).clamp(min=0.0))
        return torch.where(size * STEPS_PER_PX < last, near, wide).copysign(coc_px)

    def _summed(self, values: Picture, coc_px: Plane, aperture: Aperture, light: "Light") -> Picture:
        tables, loops = self.tables_of(aperture), self._loops
        exact, most = tables.tables.exact, light.most
        lit = (values != 0).any(dim=2)
        summed = ((coc_px.abs() - exact.from_px) / (exact.to_px - exact.from_px)).clamp(0.0, 1.0) * lit
        out = torch.zeros_like(values)
        if light.least_px < exact.to_px:
            out = loops.spread_small(values, coc_px, (1.0 - summed) * lit, tables)
        if light.largest_px <= exact.from_px:
            return out
        shares = shares_of_highlights(values, coc_px, exact.from_px) if light.has_highlights else None
        if shares is not None:
            stamp(out, values, coc_px, summed * shares, aperture)
            summed = summed * (1.0 - shares)
            most = float((values.abs().amax(dim=2) * summed).amax())
        return out + self._by_differences(values, coc_px, summed, tables, light._replace(most=most))

    def _by_differences(self, values: Picture, coc_px: Plane, gain: Plane, tables: DeviceTables, light: "Light") -> Picture:
        """Return the light of `gain` times each pixel through impulses and sums."""
        loops, margin = self._loops, tables.tables.margin_px(light.largest_px)
        (height, width), growth = coc_px.shape, tables.tables.corners.growth
        size = tables.planes, height + 2 * margin, width + 2 * margin, 4
        if np.prod(size, dtype=np.int64) >= _MOST_NUMBERED:
            raise InputError(
                f"a picture of {width}x{height} px with circles of confusion of up to {light.largest_px:.0f} px is too large for the device: "
                f"leave the device out, or render it smaller"
            )
        radius = torch.sqrt(0.25 * coc_px * coc_px + growth)
        radius = torch.where(coc_px > 0, radius, -radius)
        bits = _BITS[self._whole] - log2(max(light.most, 1e-30) * tables.bound(light.least_px, light.largest_px) * tables.unit)
        scale = 2.0 ** floor(bits)
        planes = torch.zeros(size, dtype=self._whole, device=self.device)
        loops.splat(planes, values, radius, gain, tables, scale, margin)
        sums = [loops.sum_along(planes, along) for along in tables.sums]
        return loops.sum_down(torch.stack(sums) if self._by_kernels else sums, tables, 1.0 / (scale * tables.unit), margin)

    def tables_of(self, aperture: Aperture) -> DeviceTables:
        """Return the tables of an aperture on the device, computed once and kept as long as it lives."""
        found = self._tables.get(aperture)
        if found is None:
            found = self._tables[aperture] = DeviceTables.of(tables_of(aperture, *self._rectified), aperture, self.device)
        return found

    @property
    def _by_kernels(self) -> bool:
        return self.device.type == "cuda" and has_triton()

    @property
    def _loops(self) -> Any:
        if not self._by_kernels:
            return _loops
        from mrbokeh.renderers.polygon.torch_polygon import _triton

        return _triton
