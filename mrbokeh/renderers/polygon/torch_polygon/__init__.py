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

import math
from collections.abc import Sequence
from typing import Any, Literal
from weakref import WeakKeyDictionary

try:
    import torch
except ModuleNotFoundError as missing:
    from mrbokeh.system.errors import MissingExtraError

    raise MissingExtraError("torch", "train") from missing

import numpy as np
from jaxtyping import Float32
from torch import Tensor

from mrbokeh.images.layer import Layer
from mrbokeh.layering.layering import Layering
from mrbokeh.layering.padded_layers import check_reach, coc_px_of
from mrbokeh.layering.psf_over_field import reach_px
from mrbokeh.layering.torch_layering.slicing import Slices
from mrbokeh.optics.aperture import Aperture
from mrbokeh.optics.drawn_diameters import STEPS_PER_PX, drawn_table
from mrbokeh.optics.lens import Lens
from mrbokeh.renderers.polygon.directional_differences import Direction
from mrbokeh.renderers.polygon.rectification import PAPER_DIRECTIONS
from mrbokeh.renderers.polygon.tables import tables_of
from mrbokeh.renderers.polygon.torch_polygon import _loops
from mrbokeh.renderers.polygon.torch_polygon._batch import Batch
from mrbokeh.renderers.polygon.torch_polygon._corners import DeviceTables
from mrbokeh.renderers.polygon.torch_polygon._highlights import shares_of_highlights, stamp
from mrbokeh.renderers.polygon.torch_polygon._loops import summed_shares
from mrbokeh.system.errors import InputError
from mrbokeh.system.torch_device import device_named, has_triton

Picture = Float32[Tensor, "height width 4"]
Plane = Float32[Tensor, "height width"]


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
        self._sent: dict[tuple[float, ...], Tensor] = {}

    def sum_kernels(self, values: Picture, coc_px: Plane, aperture: Aperture) -> Picture:
        """Return the sum over all pixels of light times kernel, of the same size; light that leaves the frame is lost.

        values (H, W, 4): linear, premultiplied. coc_px (H, W): signed diameters. aperture: plain. Waits once for the device.
        """
        most, largest_px, is_suspect, *below = self._loops.survey(values, coc_px).tolist()
        _require_finite(largest_px)
        if largest_px <= 1.0:
            return values.clone()
        light, _ = self._summed(Slices.single(values, coc_px, largest_px), aperture, most, _lowest(below), is_suspect > 0.0)
        return light.reshape(values.shape)

    def render(self, rgb: Float32[Tensor, "height width 3"], coc_px: Plane, aperture: Aperture, slices: int = 16) -> Picture:
        """Return an opaque picture as the lens sees it, in slices: R, G, B and coverage 1. Needs a GPU with Triton.

        rgb: linear. coc_px: signed diameters of the circle of confusion. aperture: plain.
        """
        from mrbokeh.layering.torch_layering.cutting import cut, put_together

        drawn_px = self._drawn_px(coc_px, aperture)
        most, largest_px, is_suspect, *below = self._loops.survey(torch.cat([rgb, torch.ones_like(rgb[..., :1])], dim=2), drawn_px).tolist()
        _require_finite(largest_px)
        layers = cut(rgb, drawn_px, reach_px(aperture, largest_px), largest_px, slices)
        light, batch = self._summed(layers, aperture, most, _lowest(below), is_suspect > 0.0)
        return put_together(light, batch.places, batch.starts, layers.frame)

    def takes(self, layers: Sequence[Layer], lens: Lens, layering: Layering) -> bool:
        """Return whether `render_layer` can render these layers: one opaque picture, a plain aperture, and kernels for the device."""
        if len(layers) != 1 or layers[0].extra or not layering.fill or not lens.aperture.is_plain:
            return False
        return self._by_kernels and bool((layers[0].alpha == 1.0).all())

    def render_layer(self, layer: Layer, lens: Lens, slices: int) -> Layer:
        """Render an opaque layer, whose pixels come from the host and go back there."""
        coc_px = coc_px_of(layer, lens)
        check_reach([layer], [coc_px], reach_px(lens.aperture, float(np.abs(coc_px).max())))
        found = self.render(self._sent_array(layer.rgb), self._sent_array(coc_px), lens.aperture, slices).cpu().numpy()
        return Layer(np.ascontiguousarray(found[..., :3]), np.ascontiguousarray(found[..., 3]), layer.depth_m)

    def sum_arrays(
        self, values: Float32[np.ndarray, "height width channels"], coc_px: Float32[np.ndarray, "height width"], aperture: Aperture
    ) -> Float32[np.ndarray, "height width channels"]:
        """Sum kernels of light on the host, any number of channels, as mrbokeh.layering.psf_over_field.KernelSum says."""
        circles, spreads = self._sent_array(coc_px), []
        for first in range(0, values.shape[2], 4):
            part = values[..., first : first + 4]
            light = self._sent_array(np.pad(part, ((0, 0), (0, 0), (0, 4 - part.shape[2]))))
            spreads.append(self.sum_kernels(light, circles, aperture)[..., : part.shape[2]].cpu().numpy())
        return np.ascontiguousarray(spreads[0] if len(spreads) == 1 else np.concatenate(spreads, axis=2))

    def _sent_array(self, array: np.ndarray) -> Tensor:
        return torch.from_numpy(np.ascontiguousarray(array)).to(self.device)

    def _drawn_px(self, coc_px: Plane, aperture: Aperture) -> Plane:
        """Return `drawn_diameters_px` of a plane on the device."""
        table = torch.from_numpy(drawn_table(aperture)).to(self.device)
        last = len(table) - 1
        size = coc_px.abs()
        at = (size * STEPS_PER_PX).clamp(max=last)
        lower = torch.nan_to_num(at).long().clamp(0, last - 1)
        near = table[lower] + (at - lower) * (table[lower + 1] - table[lower])
        wide = torch.sqrt((size * size - (last / STEPS_PER_PX) ** 2 + table[last] ** 2).clamp(min=0.0))
        return torch.where(size * STEPS_PER_PX < last, near, wide).copysign(coc_px)

    def _summed(
        self, slices: Slices, aperture: Aperture, most: float, lowest: tuple[float, ...], may_outshine: bool
    ) -> tuple[Float32[Tensor, "pixels 4"], Batch]:
        """Return the light of all slices, one after the other, and where each lies."""
        tables, kept = self.tables_of(aperture), None
        exact, front, circles = tables.tables.exact, slices.values[0], slices.coc_px[0]
        shares = None
        if self._exact_highlights and may_outshine and slices.largest_px > exact.from_px:
            shares = shares_of_highlights(front, circles, exact.from_px)
        if shares is not None:
            kept = 1.0 - shares
            rest = front.abs().amax(dim=2) * summed_shares(circles, tables) * kept
            most = max(float(each.abs().amax()) for each in (rest, *slices.values[1:]))
        light, batch = self._loops.sum_slices(slices, kept, tables, most, self._sent_numbers(lowest), self._whole)
        if shares is not None:
            stamp(light, batch, summed_shares(circles, tables) * shares, aperture)
        return light, batch

    def _sent_numbers(self, numbers: tuple[float, ...]) -> Tensor:
        """Return numbers on the device, sent there once."""
        if numbers not in self._sent:
            self._sent[numbers] = torch.tensor(numbers, dtype=torch.float32, device=self.device)
        return self._sent[numbers]

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


def _lowest(below: list[float]) -> tuple[float, ...]:
    """Return below what no channel of the result falls: 0 where no light is negative."""
    return tuple(-math.inf if each > 0.0 else 0.0 for each in below)


def _require_finite(largest_px: float) -> None:
    if not largest_px < math.inf:
        raise InputError("every visible pixel needs a finite circle of confusion: depth must be positive (or inf), not 0 or NaN")
