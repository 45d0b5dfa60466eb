"""OURS, SPLAT and FILTER of Leimkuehler et al. 2018, Section 7: three ways to add up light with the kernels of one bank."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from jaxtyping import Bool, Float32
from scipy.ndimage import distance_transform_edt

from datasets_scripts.gathering_filter import gathered
from datasets_scripts.global_layers import GlobalLayer
from mrbokeh.images.layer import Layer
from mrbokeh.layering.light_field_samples import LightFieldSamples
from mrbokeh.optics.lens import Lens
from mrbokeh.optics.psf_bank import PsfBank
from mrbokeh.renderers.bank.tables import BankTables, Place
from mrbokeh.renderers.kernels.spreadlets import UNRELAXED, Sparsification
from mrbokeh.renderers.spreadlets.laplacian_spreadlets import LaplacianSpreadlets

Light = Float32[np.ndarray, "height width _"]


@dataclass(frozen=True)
class _Densely(LaplacianSpreadlets):
    """The same renderer with all taps of the same kernels."""

    def spread_bank(self, values: np.ndarray, coc_px: np.ndarray, place: Place, densely: bool = True) -> np.ndarray:  # noqa: ARG002
        return super().spread_bank(values, coc_px, place, densely=True)


class BlurMethods:
    """Tables of one bank; they are filled when a method first meets a kernel and kept."""

    def __init__(self, bank: PsfBank, sparsification: Sparsification = UNRELAXED, threads: int = 0) -> None:
        self.bank, self.threads = bank, threads
        self._sparse = LaplacianSpreadlets(bank, threads=threads, sparsification=sparsification)
        self._dense = _Densely(bank, threads=threads)
        self._taps = BankTables(bank, None)

    def ours(self, layer: GlobalLayer, margin_px: int) -> Light:
        """Spreadlets."""
        return _inside(self._sparse.spread_bank(layer.values, layer.coc_px, layer.place), margin_px)

    def splat(self, layer: GlobalLayer, margin_px: int) -> Light:
        """All taps of the bank's kernels."""
        return _inside(self._dense.spread_bank(layer.values, layer.coc_px, layer.place), margin_px)

    def filter(self, layer: GlobalLayer, margin_px: int) -> Light:
        """Every pixel of the frame gathers with the kernel that it has itself; where the layer is empty, with that of its nearest pixel."""
        whole = layer if layer.is_opaque else _continued(layer)
        coc_px, place = _inside(whole.coc_px, margin_px), _place_inside(whole.place, margin_px)
        codes = self._taps.codes(coc_px, np.zeros(coc_px.shape, np.bool_), place)
        used, cells = np.unique(codes, return_inverse=True)
        cells = cells.reshape(codes.shape).astype(np.int32)
        run = partial(gathered, cells=cells, margin_px=margin_px, threads=self.threads)
        if self.bank.channels == 1:
            return run(whole.values, taps=self._taps.points(used.tolist(), True, 0))
        light = self.bank.throughput.astype(np.float32)[used // 2 // self._taps.angles][cells]
        pairs = [np.ascontiguousarray(whole.values[..., [c, 3]]) for c in range(3)]
        each = [run(pair, taps=self._taps.points(used.tolist(), True, c)) for c, pair in enumerate(pairs)]
        coverages = [both[..., 1] / light[..., c] for c, both in enumerate(each)]
        return np.stack([*(both[..., 0] for both in each), *coverages], axis=2)

    def points_over_taps(self) -> float:
        """Mean over the kernels that have been used and are not splatted densely anyway: points of the spreadlet per tap."""
        tables = self._sparse._bank_tables
        assert tables is not None
        pairs = {
            code // 2 // tables.angles: len(found.points)
            for (code, dense), found in tables._kept.items()
            if not dense and code % 2 == 0 and not tables.is_dense(code)
        }
        shares = [count / np.count_nonzero(self.bank.kernels[cell].any(axis=2)) for cell, count in pairs.items()]
        return float(np.mean(shares)) if shares else 1.0

    def by_name(self) -> Mapping[str, Callable[[GlobalLayer, int], Light]]:
        return {"ours": self.ours, "filter": self.filter, "splat": self.splat}

    def renderings(self, layers: Sequence[Layer], lens: Lens) -> Mapping[str, Callable[[], np.ndarray]]:
        """Pictures with the slices and the hidden background of mrbokeh.layering.layering, by points and by taps."""
        return {
            "ours": lambda: self._sparse.render(layers, lens).rgb,
            "splat": lambda: self._dense.render(layers, lens).rgb,
        }

    def reconstructions(self, samples: LightFieldSamples, lens: Lens) -> Mapping[str, Callable[[], np.ndarray]]:
        """Pictures from noisy samples (Section 6.2), by points and by taps."""
        return {
            "ours": lambda: self._sparse.reconstruct(samples, lens).rgb,
            "splat": lambda: self._dense.reconstruct(samples, lens).rgb,
        }


def _inside(plane: np.ndarray, margin_px: int) -> np.ndarray:
    part = slice(margin_px, -margin_px or None)
    return plane[part, part]


def _place_inside(place: Place, margin_px: int) -> Place:
    planes = (place.motion_px, place.field_xy, place.depth_m)
    return Place(*(None if plane is None else _inside(plane, margin_px) for plane in planes))


def _continued(layer: GlobalLayer) -> GlobalLayer:
    """What decides on the kernels, continued from the nearest covered pixel."""
    covered: Bool[np.ndarray, "height width"] = layer.values[..., 3] > 0
    if not covered.any():
        return layer
    rows, columns = distance_transform_edt(~covered, return_distances=False, return_indices=True)
    planes = (layer.place.motion_px, layer.place.field_xy, layer.place.depth_m)
    place = Place(*(None if plane is None else plane[rows, columns] for plane in planes))
    return replace(layer, coc_px=layer.coc_px[rows, columns], place=place)
