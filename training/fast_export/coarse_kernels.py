"""A kernel at a fraction of the resolution: gather light in tents, convolve with few taps, interpolate.

Tents are what linear interpolation does in reverse: a pixel gives its light to the cells beside it by nearness, so that the light's
centre of mass stays where it is (of a plain mean over cells it would jump by up to half a cell). A pixel at place p of its cell of
s x s, spread by coarse taps K and brought back, ends as E_p K E_p'^T with
E_p[d, j] = sum over cells c of tent(p, c) hat((p + d + 1/2) / s - 1/2 - j - c) / s, d counting pixels from p and j cells. K is
the one whose results are nearest to the kernel in the sense of squares over all s^2 places, scaled to its sum: light is conserved.
It undoes the smoothing of tents and interpolation with small negative lobes at the rim of a disc; without them the loss is two to
four times as large.
"""

import numpy as np
from jaxtyping import Float, Float64

_RIDGE = 1e-6  # tents are nearly linearly dependent


def taps_radius(radius_px: int, factor: int) -> int:
    """Cells on each side that a kernel of this radius reaches; one more than its width asks, for interpolation reaches one further."""
    return max(1, -(-(2 * radius_px + 1) // (2 * factor)))


def coarse_kernel(kernel: Float[np.ndarray, "size size"], factor: int) -> Float64[np.ndarray, "taps taps"]:
    """The taps of a kernel (size odd, values >= 0) at 1/factor of the resolution."""
    responses = _responses(kernel.shape[0] // 2, factor)
    gram, mean = np.einsum("pdi,pdj->ij", responses, responses), responses.sum(axis=0)
    solved = np.linalg.inv(gram + _RIDGE * gram.max() * np.eye(len(gram)))
    taps = solved @ (mean.T @ _padded(kernel, mean.shape[0]) @ mean) @ solved
    return taps * (kernel.sum(dtype=np.float64) / taps.sum())


def seen_kernel(taps: Float64[np.ndarray, "taps taps"], factor: int, radius_px: int) -> Float64[np.ndarray, "size size"]:
    """What a pixel is really spread by, the mean over its places in a cell."""
    mean = _responses(radius_px, factor).mean(axis=0)
    return mean @ taps @ mean.T


def binned(kernels: Float[np.ndarray, "maps size size"], factor: int) -> Float[np.ndarray, "maps taps taps"]:
    """Kernels that may be negative, for maps that stay coarse: every value goes to the cells beside it, by nearness; sums are kept."""
    radius = kernels.shape[-1] // 2
    taps = -(-radius // factor)
    away, cells = np.arange(-radius, radius + 1) / factor, np.arange(-taps, taps + 1)
    shares = np.maximum(0.0, 1.0 - np.abs(away[:, None] - cells))
    return np.einsum("mij,ia,jb->mab", kernels, shares, shares).astype(kernels.dtype)


def tent(factor: int) -> Float64[np.ndarray, " pixels"]:
    """Shares of the 2 * factor pixels around the centre of a cell that it gathers, along one side; their sum is 1."""
    away = (np.arange(2 * factor) + 0.5) / factor - 1.0
    return (1.0 - np.abs(away)) / factor


def _responses(radius_px: int, factor: int) -> Float64[np.ndarray, "factor reach taps"]:
    """E_p for every place p; the reach in pixels is wide enough for all that the taps can touch."""
    taps = taps_radius(radius_px, factor)
    reach = factor * (taps + 3)
    away, cells, places = np.arange(-reach, reach + 1), np.arange(-taps, taps + 1), np.arange(factor)
    responses = np.zeros((factor, len(away), len(cells)))
    for gatherer in (-1, 0, 1):
        share = np.maximum(0.0, 1.0 - np.abs((places + 0.5) / factor - 0.5 - gatherer))
        where = (places[:, None, None] + away[:, None] + 0.5) / factor - 0.5 - cells - gatherer
        responses += share[:, None, None] * np.maximum(0.0, 1.0 - np.abs(where)) / factor
    return responses


def _padded(kernel: np.ndarray, size: int) -> np.ndarray:
    return np.pad(kernel.astype(np.float64), (size - kernel.shape[0]) // 2)
