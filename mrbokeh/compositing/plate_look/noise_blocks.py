"""A picture cut into blocks, to look for its noise: what is left of each when a smooth surface is taken out."""

from dataclasses import dataclass
from functools import cache

import numpy as np
from jaxtyping import Bool, Float32, Float64

from mrbokeh.system.errors import InputError

Picture = Float32[np.ndarray, "height width 3"]
BLOCK_PX = 16
_MOST_BLOCKS = 20000


@dataclass(frozen=True)
class NoiseBlocks:
    """residual: (N, 3, P) values of P = BLOCK_PX^2 pixels less the paraboloid that fits them best. level: (N, 3) their mean.

    usable: (N,) neither clipped nor, in a difference of frames, an exact copy.
    """

    level: Float64[np.ndarray, "blocks 3"]
    residual: Float32[np.ndarray, "blocks 3 pixels"]
    usable: Bool[np.ndarray, " blocks"]

    @property
    def variance(self) -> Float64[np.ndarray, "blocks 3"]:
        """Unbiased where neighbours are independent."""
        degrees = self.residual.shape[2] - smooth_basis().shape[1]
        return np.einsum("ncp,ncp->nc", self.residual, self.residual, dtype=np.float64) / degrees

    @property
    def kurtosis(self) -> Float64[np.ndarray, "blocks 3"]:
        """3 for normal noise of any strength; edges and specks have more. Its test is independent of the variance (Basu's theorem)."""
        second = np.einsum("ncp,ncp->nc", self.residual, self.residual, dtype=np.float64)
        squares = self.residual.astype(np.float64) ** 2
        fourth = np.einsum("ncp,ncp->nc", squares, squares)
        return self.residual.shape[2] * fourth / np.maximum(second, 1e-30) ** 2

    def only(self, chosen: Bool[np.ndarray, " blocks"]) -> "NoiseBlocks":
        return NoiseBlocks(self.level[chosen], self.residual[chosen], self.usable[chosen])


def noise_blocks(rgb: Picture) -> NoiseBlocks:
    """Blocks of one picture; those that hold a channel's least or greatest value in several pixels are clipped."""
    blocks = _cut(rgb)
    low, high = rgb.min(axis=(0, 1)), rgb.max(axis=(0, 1))
    at_end = (blocks <= low[:, None]) | (blocks >= high[:, None])
    clipped = (at_end.sum(axis=2) > 2).any(axis=1) & (np.ptp(blocks, axis=2) > 0).any(axis=1)
    return _blocks(blocks, blocks.mean(axis=2, dtype=np.float64), ~clipped)


def noise_blocks_of_pair(first: Picture, second: Picture) -> NoiseBlocks:
    """Blocks of the difference of two frames of a still camera, divided by sqrt(2): the noise of one frame.

    What an encoder copied from frame to frame says nothing about noise and is not usable.
    """
    if first.shape != second.shape:
        raise InputError(
            f"expected two frames of one size, got {first.shape[1]}x{first.shape[0]} and {second.shape[1]}x{second.shape[0]} px"
        )
    mean = noise_blocks((0.5 * (first + second)).astype(np.float32))
    difference = _cut((second - first).astype(np.float32) / np.float32(np.sqrt(2.0)))
    copied = (difference == 0.0).mean(axis=2).min(axis=1) > 0.5
    return _blocks(difference, mean.level, mean.usable & ~copied)


def _blocks(values: Float32[np.ndarray, "blocks 3 pixels"], level: np.ndarray, usable: np.ndarray) -> NoiseBlocks:
    basis = smooth_basis().astype(np.float32)
    # The mean first and exactly, so that an even block has no residual at all.
    values = values - values.mean(axis=2, keepdims=True, dtype=np.float64).astype(np.float32)
    return NoiseBlocks(level, values - (values @ basis) @ basis.T, usable)


def _cut(rgb: Picture) -> Float32[np.ndarray, "blocks 3 pixels"]:
    """Blocks side by side, evenly left out where there are more than are needed."""
    rows, columns = rgb.shape[0] // BLOCK_PX, rgb.shape[1] // BLOCK_PX
    if not rows or not columns:
        raise InputError(
            f"expected a picture of {BLOCK_PX}x{BLOCK_PX} px or more to measure grain in, got {rgb.shape[1]}x{rgb.shape[0]} px"
        )
    cut = rgb[: rows * BLOCK_PX, : columns * BLOCK_PX].reshape(rows, BLOCK_PX, columns, BLOCK_PX, 3)
    step = -(-rows * columns // _MOST_BLOCKS)
    blocks = cut.transpose(0, 2, 4, 1, 3).reshape(rows * columns, 3, BLOCK_PX * BLOCK_PX)
    return np.ascontiguousarray(blocks[::step])


@cache
def smooth_basis() -> Float64[np.ndarray, "pixels 6"]:
    """Orthonormal columns that span the paraboloids over a block: out-of-focus places bend, and bending is not noise."""
    y, x = (each.ravel() for each in np.mgrid[-1.0 : 1.0 : BLOCK_PX * 1j, -1.0 : 1.0 : BLOCK_PX * 1j])
    return np.linalg.qr(np.stack([np.ones_like(x), x, y, x * x, x * y, y * y], axis=1))[0]
