"""Kernels of many maps as sums of separable ones, applied as matrix products.

A one-dimensional convolution of a row in pieces of T pixels is the product of the pieces, each with a margin, and a banded (Toeplitz)
matrix of (T + 2n) x T. That is more multiplications than a convolution takes, but a processor does them about ten times faster
than ONNX Runtime convolves with long thin kernels.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Float32

from mrbokeh.renderers.kernels.low_rank_kernel import decompose
from training.fast_export.graph_builder import GraphBuilder


@dataclass(frozen=True)
class SeparableKernels:
    """columns, rows: (maps, rank, 2n+1); kernel m is the sum over r of outer(columns[m, r], rows[m, r]).

    relative_error: what is missing, norm over norm, of all kernels together.
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
    """The best of this rank with the sum of each kernel kept (`kernels.low_rank_kernel`); a kernel of all zeros stays so."""
    columns, rows = (np.zeros((len(kernels), rank, kernels.shape[1])) for _ in range(2))
    for index, kernel in enumerate(kernels):
        if kernel.any():
            short = decompose(kernel, max_rank=rank)
            columns[index, : short.rank], rows[index, : short.rank] = short.scaled_columns, short.scaled_rows
    missing = np.linalg.norm(kernels - np.einsum("mry,mrx->myx", columns, rows)) / max(float(np.linalg.norm(kernels)), 1e-30)
    return SeparableKernels(columns.astype(np.float32), rows.astype(np.float32), float(missing))


def convolve_separably(graph: GraphBuilder, padded: str, kernels: SeparableKernels, size: tuple[str, str]) -> str:
    """padded (B, maps, H + 2n, W + 2n) correlated with each map's kernel: (B, maps, H, W). size: values of shape (1,) for H and W."""
    piece = piece_px(kernels.radius_px)
    rows, columns = (_pieces(graph, each, piece) for each in size)
    across = _across(graph, padded, kernels, columns, piece)
    return _down(graph, across, kernels, (rows, size[0], size[1]), piece)


def piece_px(radius_px: int) -> int:
    """T: longer pieces waste more of the matrix, shorter ones more of the margins."""
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
    """The sum over terms; pieces of rows, with their margins, are gathered by index."""
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
    """Matrix m maps T + 2n pixels to their correlation with vector m at T places."""
    maps, size = vectors.shape
    matrix = np.zeros((maps, piece + size - 1, piece), np.float32)
    for place in range(piece):
        matrix[:, place : place + size, place] = vectors
    return matrix
