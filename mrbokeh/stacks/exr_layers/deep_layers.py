"""A deep picture as a few layers for lens blur, by what lies behind what at each pixel or by slices of depth.

All layers laid over one another are the flat picture. Each keeps one depth per pixel, the mean in dioptres of what is seen of it, because
blur grows evenly with dioptres.

- DeepSurfaces: each pixel's first surface is in the first layer, its second in the second. A surface that recedes stays whole.
- DeepSlices: layers lie between depths. A surface that goes through such a depth is cut in two, and blurred it lets light through along
  the cut (0.21 of it in tests): edges belong into gaps. For fog and for things that stand apart.
"""

import itertools
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float64

from mrbokeh.images.layer import Layer, clear
from mrbokeh.stacks.exr_layers.deep_samples import DeepSamples
from mrbokeh.system.errors import InputError


@dataclass(frozen=True)
class DeepSurfaces:
    """Reads a deep EXR as layers of what is first, second and so on at each pixel.

    surfaces: layers at most; the last one takes all that is left. apart: samples belong to one surface as long as their depth exceeds
    that of its first by no more than this part of it. part: name of the deep part, where there are several.
    """

    surfaces: int = 4
    apart: float = 0.02
    part: str = ""
    metres_per_unit: float = 1.0

    def __post_init__(self) -> None:
        if self.surfaces < 1 or not self.metres_per_unit > 0 or not self.apart > 0:
            raise InputError(
                f"surfaces, apart and metres per unit must be above 0, got {self.surfaces}, {self.apart}, {self.metres_per_unit}"
            )

    def layers(self, path: Path | str) -> list[Layer]:
        """Front first; layers in which nothing is are left out."""
        return _full(peeled(self.samples(path), self.surfaces, self.apart))

    def samples(self, path: Path | str) -> DeepSamples:
        """As they are in the file, in metres."""
        return DeepSamples.read(path, self.part, self.metres_per_unit)


@dataclass(frozen=True)
class DeepSlices:
    """Reads a deep EXR as layers.

    edges_m: depths between which slices lie, ascending; one more slice than edges. Without them `slices` of about equal coverage
    are made, cut in gaps where there are any. part: name of the deep part, where there are several.
    """

    edges_m: tuple[float, ...] | None = None
    slices: int = 4
    part: str = ""
    metres_per_unit: float = 1.0

    def __post_init__(self) -> None:
        if self.slices < 1 or not self.metres_per_unit > 0:
            raise InputError(f"expected slices and metres per unit above 0, got {self.slices} and {self.metres_per_unit}")
        if self.edges_m is not None and (list(self.edges_m) != sorted(set(self.edges_m)) or min(self.edges_m, default=1.0) <= 0):
            raise InputError(f"edges of depth slices must be above 0 and ascend, got {', '.join(f'{each:g}' for each in self.edges_m)}")

    def layers(self, path: Path | str) -> list[Layer]:
        """Front first; slices in which nothing is are left out."""
        samples = DeepSamples.read(path, self.part, self.metres_per_unit)
        edges_m = even_edges_m(samples, self.slices) if self.edges_m is None else np.array(self.edges_m, np.float64)
        return _full(sliced(samples, edges_m))


def sliced(samples: DeepSamples, edges_m: Float64[np.ndarray, " edges"]) -> list[Layer]:
    """One layer for each slice of depth, front first, also where it is empty. What lies at an edge belongs behind it."""
    return _flattened(samples, np.asarray(edges_m, np.float64), len(edges_m) + 1, 0.0)


def peeled(samples: DeepSamples, surfaces: int, apart: float) -> list[Layer]:
    """One layer for the first, second, ... surface of every pixel, front first, also where it is empty; see DeepSurfaces."""
    return _flattened(samples, np.zeros(0), surfaces, apart)


def _flattened(samples: DeepSamples, edges_m: Float64[np.ndarray, " edges"], count: int, apart: float) -> list[Layer]:
    from mrbokeh.stacks.exr_layers._deep_numba import flatten_layers

    size = (samples.height_px, samples.width_px)
    out, dioptres = np.zeros((count, size[0] * size[1], 4)), np.zeros((count, size[0] * size[1]))
    rgba = np.column_stack([samples.rgb, samples.alpha]).astype(np.float64)
    marks = np.empty(2 * int(samples.counts.max(initial=0)) + len(edges_m))
    flatten_layers(samples.starts, rgba, samples.front_m, samples.back_m, edges_m, apart, marks, out, dioptres)
    return [_layer(rgba_of, dioptres_of, size) for rgba_of, dioptres_of in zip(out, dioptres, strict=True)]


def _full(layers: list[Layer]) -> list[Layer]:
    """Those in which anything is; an empty one where there are none."""
    return [layer for layer in layers if (layer.alpha != 0).any() or (layer.rgb != 0).any()] or [clear(*layers[0].alpha.shape)]


def even_edges_m(samples: DeepSamples, slices: int) -> Float64[np.ndarray, " edges"]:
    """Edges of slices that hold about equal coverage, each moved to the widest gap in dioptres near it; fewer if all lies in one place."""
    middle_dioptres = 2.0 / (samples.front_m + samples.back_m)
    is_seen = samples.alpha > 0
    order = np.argsort(-middle_dioptres[is_seen])
    dioptres, coverage = middle_dioptres[is_seen][order], np.cumsum(samples.alpha[is_seen][order], dtype=np.float64)
    if not len(dioptres):
        return np.zeros(0)
    bounds = np.searchsorted(coverage / coverage[-1], (np.arange(slices) + 0.5) / slices)
    edges = [_widest_gap(dioptres, int(first), int(last)) for first, last in itertools.pairwise(bounds)]
    return np.unique([1.0 / each for each in edges if each is not None]).astype(np.float64)


def _widest_gap(dioptres: Float64[np.ndarray, " samples"], first: int, last: int) -> float | None:
    """The middle of the widest gap among falling dioptres from one sample to another; None where there is no gap at all."""
    gaps = -np.diff(dioptres[first : last + 1])
    if not len(gaps) or gaps.max() <= 0:
        return None
    before = first + int(np.argmax(gaps))
    return float(0.5 * (dioptres[before] + dioptres[before + 1]))


def _layer(rgba: Float64[np.ndarray, "pixels 4"], dioptres: Float64[np.ndarray, " pixels"], size: Sequence[int]) -> Layer:
    depth_m = np.divide(1.0, dioptres, out=np.full_like(dioptres, np.inf), where=dioptres > 0)
    picture = rgba.astype(np.float32).reshape(*size, 4)
    return Layer(np.ascontiguousarray(picture[..., :3]), np.ascontiguousarray(picture[..., 3]), depth_m.astype(np.float32).reshape(*size))
