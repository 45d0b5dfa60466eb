"""The published form as a graph whose convolutions are in a layout that ONNX Runtime is fast at.

Channel by channel convolutions are about ten times faster where channels come in multiples of 16. A network of many tiles gets a
few channels of zeros; one of few tiles is cut into strips of rows for every convolution, which become channels. Neither changes the
result. Blocks may have separable kernels instead, or run at half or a quarter of the resolution: these do change it.

Separable kernels are applied as matrix products: a one-dimensional convolution of a row in pieces of T pixels is the product of the
pieces, each with a margin, and a banded (Toeplitz) matrix of (T + 2n) x T. That is more multiplications than a convolution takes, but
a processor does them about ten times faster than ONNX Runtime convolves with long thin kernels.
"""

import functools
import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Float32
from onnx import ModelProto
from torch import nn

from mrbokeh.renderers.kernels.low_rank_kernel import decompose
from mrbokeh.system.errors import InputError
from training.export.graph_builder import GraphBuilder, binned, enlarged
from training.networks.network import BlurNetwork, tile_count
from training.networks.published_network import PublishedTiles, ResidualBlock

CHANNELS = 16
_SPARE = 1.1  # so many times the channels may be computed in vain before strips are worth their margins
_MODES = {"replicate": "edge", "reflect": "reflect", "zeros": "constant"}


@dataclass(frozen=True)
class SeparableKernels:
    """Kernels as sums of separable ones.

    columns, rows: (maps, rank, 2n+1); kernel m is the sum over r of outer(columns[m, r], rows[m, r]).
    relative_error: of all kernels together, norm over norm.
    """

    columns: Float32[np.ndarray, "maps rank size"]
    rows: Float32[np.ndarray, "maps rank size"]
    relative_error: float

    @property
    def rank(self) -> int:
        return self.columns.shape[1]

    @property
    def radius_px(self) -> int:
        return self.columns.shape[2] // 2


def separable_kernels(kernels: Float[np.ndarray, "maps size size"], rank: int) -> SeparableKernels:
    """Return the best approximation of this rank with the sum of each kernel kept (`kernels.low_rank_kernel`); zeros stay zeros."""
    columns, rows = (np.zeros((len(kernels), rank, kernels.shape[1])) for _ in range(2))
    for index, kernel in enumerate(kernels):
        if kernel.any():
            short = decompose(kernel, max_rank=rank)
            columns[index, : short.rank], rows[index, : short.rank] = short.scaled_columns, short.scaled_rows
    missing = np.linalg.norm(kernels - np.einsum("mry,mrx->myx", columns, rows)) / max(float(np.linalg.norm(kernels)), 1e-30)
    return SeparableKernels(columns.astype(np.float32), rows.astype(np.float32), float(missing))


def convolve_separably(graph: GraphBuilder, padded: str, kernels: SeparableKernels, size: tuple[str, str]) -> str:
    """Correlate padded (B, maps, H + 2n, W + 2n) with each map's kernel: (B, maps, H, W). size: values of shape (1,) for H and W."""
    piece = piece_px(kernels.radius_px)
    rows, columns = (_pieces(graph, each, piece) for each in size)
    across = _across(graph, padded, kernels, columns, piece)
    return _down(graph, across, kernels, (rows, size[0], size[1]), piece)


def piece_px(radius_px: int) -> int:
    """Return T: longer pieces waste more of the matrix, shorter ones more of the margins."""
    return 64 if radius_px > 12 else 32


def _pieces(graph: GraphBuilder, length: str, piece: int) -> str:
    return graph.op("Div", graph.op("Add", length, graph.ints([piece - 1])), graph.ints([piece]))


def _across(graph: GraphBuilder, padded: str, kernels: SeparableKernels, columns: str, piece: int) -> list[str]:
    """Spread light across for every term: (B, maps, H + 2n, pieces * T)."""
    height, maps, margin = graph.size(padded, 2), kernels.rows.shape[0], 2 * kernels.radius_px
    wide = graph.op("Mul", graph.op("Add", columns, graph.ints([1])), graph.ints([piece]))
    missing = graph.op("Sub", wide, graph.size(padded, 3))
    grown = graph.op("Pad", padded, graph.op("Concat", graph.ints([0] * 7), missing, axis=0))
    shape = graph.op("Concat", graph.ints([0, maps]), height, graph.op("Add", columns, graph.ints([1])), graph.ints([piece]), axis=0)
    blocks = graph.op("Reshape", grown, shape)
    parts = [graph.sliced(blocks, 0, columns, 3)]
    for first in range(0, margin, piece):
        following = graph.sliced(blocks, 1 + first // piece, graph.op("Add", columns, graph.ints([1 + first // piece])), 3)
        parts.append(graph.sliced(following, 0, min(piece, margin - first), 4))
    windows = graph.op("Reshape", graph.op("Concat", *parts, axis=4), graph.ints([0, maps, -1, piece + margin]))
    flat = graph.op("Concat", graph.ints([0, maps]), height, graph.ints([-1]), axis=0)
    bands = [_toeplitz(kernels.rows[:, r], piece) for r in range(kernels.rank)]
    return [graph.op("Reshape", graph.op("MatMul", windows, graph.floats(band)), flat) for band in bands]


def _down(graph: GraphBuilder, across: list[str], kernels: SeparableKernels, sizes: tuple[str, str, str], piece: int) -> str:
    """Sum over the terms; pieces of rows, with their margins, are gathered by index."""
    rows, height, width = sizes
    starts = graph.op("Mul", graph.op("Range", graph.ints(0), graph.op("Squeeze", rows), graph.ints(1)), graph.ints(piece))
    reach = graph.ints(np.arange(piece + 2 * kernels.radius_px)[None])
    last = graph.op("Add", height, graph.ints([2 * kernels.radius_px - 1]))
    index = graph.op("Min", graph.op("Add", graph.op("Unsqueeze", starts, graph.ints([1])), reach), last)
    windows = graph.op("Concat", *(graph.op("Gather", graph.sliced(each, 0, width, 3), index, axis=2) for each in across), axis=3)
    bands = [np.swapaxes(_toeplitz(kernels.columns[:, r], piece), 1, 2) for r in range(kernels.rank)]
    blocks = graph.op("MatMul", graph.floats(np.concatenate(bands, axis=2)[:, None]), windows)
    whole = graph.op("Reshape", blocks, graph.op("Concat", graph.ints([0, kernels.columns.shape[0], -1]), width, axis=0))
    return graph.sliced(whole, 0, height, 2)


def _toeplitz(vectors: Float32[np.ndarray, "maps size"], piece: int) -> Float32[np.ndarray, "maps reach piece"]:
    """Return matrices that map T + 2n pixels to their correlation with vector m at T places."""
    maps, size = vectors.shape
    matrix = np.zeros((maps, piece + size - 1, piece), np.float32)
    for place in range(piece):
        matrix[:, place : place + size, place] = vectors
    return matrix


@dataclass(frozen=True)
class BlockPlan:
    """The plan of a block. factor: reduction of its resolution. rank: of its kernels, or None to leave them whole."""

    factor: int = 1
    rank: int | None = None


class PublishedGraph:
    """A writer of the graph of one network; `plans` has one for each block."""

    def __init__(self, network: BlurNetwork, plans: Sequence[BlockPlan]) -> None:
        assert isinstance(network.tiles, PublishedTiles)
        self.network, self.tiles, self.plans, self.graph = network, network.tiles, plans, GraphBuilder()
        features = int(self.tiles.c1.weight.shape[0])
        if any(block.first.groups != features for block in blocks_of(self.tiles)):
            raise InputError("a fast export needs convolutions channel by channel, got mixing 'colour': export without --fast")
        if network.field_position or network.lens_scale is not None:
            raise InputError("a fast export of the published form cannot take place or lens as inputs: export without --fast")
        self.channels = math.ceil(features / CHANNELS) * CHANNELS
        self.strips = 1
        if self.channels > _SPARE * features:
            self.channels, self.strips = features, CHANNELS // math.gcd(CHANNELS, features)

    def model(self) -> ModelProto:
        graph = self.graph
        x = self._encoded()
        self.height, self.width = graph.size(x, 2), graph.size(x, 3)
        state = graph.op("Conv", x, *self._widened(self.tiles.c1), group=1)
        for block, plan in zip(blocks_of(self.tiles), self.plans, strict=True):
            state = self._mixed(graph.op("Relu", graph.op("Add", state, self._change(state, block, plan))), block)
        y = self._pictures(state, x)
        half = graph.floats(0.5 * self.network.top)
        blurred = graph.op("Mul", graph.op("Add", y, graph.floats(1.0)), half)
        sizes: list[int | str] = (
            ["height", "width"] if self.network.grid is None else [self.network.grid.height_px, self.network.grid.width_px]
        )
        return graph.model({"rgb": ["batch", 3, *sizes], "coc_px": ["batch", 1, *sizes]}, blurred, ["batch", 3, *sizes])

    def _encoded(self) -> str:
        """Return (B, 4 tiles, t, t) in [-1, 1]."""
        graph, network = self.graph, self.network
        one = graph.floats(1.0)
        fraction = graph.op("Div", "coc_px", graph.floats(network.largest_coc_px))
        if network.signed_coc:
            coc = graph.op("Clip", fraction, graph.floats(-1.0), one)
        else:
            coc = graph.op("Sub", graph.op("Mul", graph.op("Min", graph.op("Abs", fraction), one), graph.floats(2.0)), one)
        colour = graph.op("Sub", graph.op("Mul", "rgb", graph.floats(2.0 / network.top)), one)
        x = graph.op("Concat", colour, coc, axis=1)
        if network.grid is None:
            return x
        height, width = network.grid.tile_size_px
        cuts = [graph.sliced(graph.sliced(x, top, top + height, 2), left, left + width, 3) for top, left in network.grid.origins_px]
        return graph.op("Concat", *cuts, axis=1) if len(cuts) > 1 else cuts[0]

    def _widened(self, convolution: nn.Conv2d) -> tuple[str, str]:
        """Return a grouped pointwise convolution as a full one, with spare outputs that are 0."""
        assert convolution.bias is not None
        grouped, groups = convolution.weight.detach()[:, :, 0, 0].numpy(), convolution.groups
        outputs, inputs = grouped.shape
        full = np.zeros((self.channels, groups * inputs, 1, 1), np.float32)
        for output in range(outputs):
            first = output // (outputs // groups) * inputs
            full[output, first : first + inputs, 0, 0] = grouped[output]
        return self.graph.floats(full), self.graph.floats(np.pad(convolution.bias.detach().numpy(), (0, self.channels - outputs)))

    def _mixed(self, state: str, block: ResidualBlock) -> str:
        if not isinstance(block.mix, nn.Conv2d):
            return state
        if self.channels > block.mix.out_channels:
            state = self.graph.sliced(state, 0, block.mix.out_channels, 1)
        return self.graph.op("Conv", state, *self._widened(block.mix), group=1)

    def _change(self, state: str, block: ResidualBlock, plan: BlockPlan) -> str:
        """Return what a block adds to the state."""
        graph, factor = self.graph, plan.factor
        if factor == 1:
            return self._two_convolutions(state, (self.height, self.width), block, plan)
        missing = [graph.op("Mod", graph.op("Neg", each), graph.ints([factor])) for each in (self.height, self.width)]
        grown = graph.op("Pad", state, graph.op("Concat", graph.ints([0] * 6), *missing, axis=0), mode="edge")
        coarse = graph.op("AveragePool", grown, kernel_shape=[factor] * 2, strides=[factor] * 2)
        change = self._two_convolutions(coarse, (graph.size(coarse, 2), graph.size(coarse, 3)), block, plan)
        return graph.sliced(graph.sliced(enlarged(graph, change, factor), 0, self.height, 2), 0, self.width, 3)

    def _two_convolutions(self, state: str, size: tuple[str, str], block: ResidualBlock, plan: BlockPlan) -> str:
        hidden = self.graph.op("Relu", self._convolved(state, size, block.first, plan, block.padding))
        return self._convolved(hidden, size, block.second, plan, block.padding)

    def _convolved(self, state: str, size: tuple[str, str], convolution: nn.Conv2d, plan: BlockPlan, padding: str) -> str:
        graph = self.graph
        kernels, bias = kernels_of(convolution, self.channels, plan.factor)
        n = kernels.shape[-1] // 2
        padded = graph.op("Pad", state, graph.ints([0, 0, n, n, 0, 0, n, n]), mode=_MODES[padding])
        if plan.rank is not None:
            separable = separable_kernels(kernels, plan.rank)
            return graph.op("Add", convolve_separably(graph, padded, separable, size), graph.floats(bias[:, None, None]))
        weights = [np.repeat(each, self.strips, axis=0) for each in (kernels[:, None], bias)]
        stripes = padded if self.strips == 1 else self._in_strips(padded, size[0], n)
        y = graph.op("Conv", stripes, *(graph.floats(each) for each in weights), group=len(weights[1]))
        return y if self.strips == 1 else self._joined(y, size)

    def _in_strips(self, padded: str, height: str, n: int) -> str:
        """Cut (B, channels, H + 2n, W + 2n) into (B, channels * strips, h + 2n, W + 2n)."""
        graph = self.graph
        strip = graph.op("Div", graph.op("Add", height, graph.ints([self.strips - 1])), graph.ints([self.strips]))
        starts = graph.op("Mul", graph.ints(np.arange(self.strips)[:, None]), strip)
        reach = graph.op("Range", graph.ints(0), graph.op("Squeeze", graph.op("Add", strip, graph.ints([2 * n]))), graph.ints(1))
        last = graph.op("Sub", graph.size(padded, 2), graph.ints([1]))
        index = graph.op("Min", graph.op("Add", starts, graph.op("Unsqueeze", reach, graph.ints([0]))), last)
        shape = graph.op("Concat", graph.ints([0, self.channels * self.strips, -1]), graph.size(padded, 3), axis=0)
        return graph.op("Reshape", graph.op("Gather", padded, index, axis=2), shape)

    def _joined(self, strips: str, size: tuple[str, str]) -> str:
        graph = self.graph
        shape = graph.op("Concat", graph.ints([0, self.channels, -1]), size[1], axis=0)
        return graph.sliced(graph.op("Reshape", strips, shape), 0, size[0], 2)

    def _pictures(self, state: str, x: str) -> str:
        """Apply C2 over features and colours of each tile, then average the tiles where they overlap."""
        graph, tiles, grid = self.graph, self.tiles.tile_count, self.network.grid
        features, inputs = self.tiles.c1.out_channels // tiles, self.tiles.c1.in_channels // tiles
        order = [place for tile in range(tiles) for place in _tile_channels(tile, features, inputs, self.channels)]
        joined = graph.op("Gather", graph.op("Concat", state, x, axis=1), graph.ints(order), axis=1)
        assert self.tiles.c2.bias is not None
        weights = (graph.floats(each.detach().numpy()) for each in (self.tiles.c2.weight, self.tiles.c2.bias))
        y = graph.op("Conv", joined, *weights, group=tiles)
        y = graph.op("Tanh", y) if self.tiles.activation == "tanh" else y
        if grid is None:
            return y
        (height, width), parts = grid.tile_size_px, graph.ops("Split", y, outputs=tiles, axis=1, num_outputs=tiles) if tiles > 1 else [y]
        pads = [[0, 0, top, left, 0, 0, grid.height_px - top - height, grid.width_px - left - width] for top, left in grid.origins_px]
        placed = [graph.op("Pad", part, graph.ints(pad)) for part, pad in zip(parts, pads, strict=True)]
        total = functools.reduce(lambda a, b: graph.op("Add", a, b), placed)
        return graph.op("Div", total, graph.floats(tile_count(grid).numpy()))


def kernels_of(convolution: nn.Conv2d, channels: int, factor: int = 1) -> tuple[np.ndarray, np.ndarray]:
    """Return (channels, k, k) at a fraction of the resolution, and (channels,); spare ones 0."""
    assert convolution.bias is not None
    spare = channels - convolution.out_channels
    kernels = convolution.weight.detach()[:, 0].numpy()
    if factor > 1:
        kernels = binned(kernels, factor)
    return np.pad(kernels, ((0, spare), (0, 0), (0, 0))), np.pad(convolution.bias.detach().numpy(), (0, spare))


def blocks_of(tiles: PublishedTiles) -> list[ResidualBlock]:
    """Return the residual blocks in their order."""
    return [block for block in tiles.blocks if isinstance(block, ResidualBlock)]


def _tile_channels(tile: int, features: int, inputs: int, channels: int) -> list[int]:
    colours = [channels + tile * inputs + colour for colour in range(3)]
    return [*range(tile * features, (tile + 1) * features), *colours]
