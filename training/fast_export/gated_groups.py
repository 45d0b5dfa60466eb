"""The bins of the gated form in groups that are computed together, each at a resolution of its own."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from training.fast_export.coarse_kernels import coarse_kernel
from training.gated_network import GatedTiles

CHANNELS = 16  # ONNX Runtime convolves channel by channel in blocks of so many


@dataclass(frozen=True)
class Group:
    """bins: of the network; factor: 1, 2 or 4, by which their resolution is lowered; weights: (bins * bases * maps, 1, k, k) for Conv.

    lowest_px, highest_px: pairs of signed diameters between which a pixel belongs to one of these bins.
    """

    bins: tuple[int, ...]
    factor: int
    weights: np.ndarray
    spans_px: tuple[tuple[float, float], ...]


def kernels_of(tiles: GatedTiles, n: int) -> np.ndarray:
    """(bins of this size, bases, colours, 2n+1, 2n+1), each with sum 1."""
    magnitude = tiles.kernels[n - 1].detach().abs()[0].double()
    kernels = magnitude / magnitude.sum(dim=(-2, -1), keepdim=True)
    return kernels.reshape(-1, tiles.bases, *kernels.shape[1:]).numpy()


def groups_of(tiles: GatedTiles, factors: Mapping[int, int]) -> list[Group]:
    """factors: for every n. Sizes of one factor share a group until it fills a block of channels."""
    together: list[list[int]] = []
    maps = (3 + tiles.colours) * tiles.bases
    for n in range(1, len(tiles.kernels) + 1):
        last = together[-1] if together else []
        if last and factors[last[0]] == factors[n] and maps * sum(tiles.radii.count(each) for each in last) < CHANNELS:
            last.append(n)
        else:
            together.append([n])
    return [_group(tiles, sizes, factors[sizes[0]]) for sizes in together]


def _group(tiles: GatedTiles, sizes: Sequence[int], factor: int) -> Group:
    kernels = [_at_resolution(kernel, factor) for n in sizes for kernel in kernels_of(tiles, n)]
    largest = max(each.shape[-1] for each in kernels)
    stacked = np.stack([_widened(each, largest) for each in kernels])  # (bins, bases, colours, k, k)
    repeats = 2 if tiles.colours == 3 else 4
    weights = np.tile(stacked, (1, 1, repeats, 1, 1)).reshape(-1, 1, largest, largest).astype(np.float32)
    bins = tuple(index for index, radius in enumerate(tiles.radii) if radius in sizes)
    return Group(bins, factor, weights, tuple(_span_px(tiles.knots, index) for index in bins))


def _at_resolution(kernels: np.ndarray, factor: int) -> np.ndarray:
    if factor == 1:
        return kernels
    return np.stack([np.stack([coarse_kernel(kernel, factor) for kernel in base]) for base in kernels])


def _widened(kernels: np.ndarray, size: int) -> np.ndarray:
    margin = (size - kernels.shape[-1]) // 2
    return np.pad(kernels, [(0, 0)] * (kernels.ndim - 2) + [(margin, margin)] * 2)


def _span_px(knots: Sequence[float], index: int) -> tuple[float, float]:
    """The knots beside this one, outermost ones open."""
    ascending = sorted(knots)
    i = ascending.index(knots[index])
    return (ascending[i - 1] if i else -np.inf), (ascending[i + 1] if i + 1 < len(ascending) else np.inf)
