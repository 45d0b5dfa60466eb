"""Rays of the simple, the combined and the stylized model: a lens point each, times half a diameter. Twins of the compiled loops,
with the same arguments after the device; each adds a block of rays to a kernel and returns its light.

Arrays that go to a device of torch, and light that is added up in bins there.
"""

import math

import numpy as np
import torch
from jaxtyping import Bool, Float64, Int64, Shaped
from torch import Tensor

from mrbokeh.system.torch_device import device_named

_BITS = 61


def on(device: torch.device, array: Shaped[np.ndarray, "..."]) -> Shaped[Tensor, "..."]:
    return torch.from_numpy(np.ascontiguousarray(array)).to(device)


def number(value: float, like: Float64[Tensor, "..."]) -> Float64[Tensor, ""]:
    """For divisions that are rounded once. With a plain number torch multiplies by a reciprocal: always where the number is the
    dividend, on GPUs where it is the divisor too."""
    return torch.full((), value, dtype=torch.float64, device=like.device)


def summed(bins: Int64[Tensor, " rays"], weights: Float64[Tensor, " rays"], count: int) -> Float64[np.ndarray, " count"]:
    """The sum of the weights that fall in each of `count` bins, to 2**-61 of rays x the largest weight: whole numbers of 64 bits."""
    largest = float(weights.abs().max()) if len(weights) else 0.0
    exponent = _BITS - math.frexp(max(largest * len(weights), 1e-200))[1]
    sums = torch.zeros(count, dtype=torch.int64, device=bins.device)
    sums.index_add_(0, bins, (weights * math.ldexp(1.0, exponent)).round().to(torch.int64))
    return sums.cpu().numpy() * math.ldexp(1.0, -exponent)


def pixels(x: Float64[Tensor, "*rays"], y: Float64[Tensor, "*rays"], size: int) -> tuple[Int64[Tensor, "*rays"], Bool[Tensor, "*rays"]]:
    """(number of the pixel of a picture `size` wide and high, row by row, and whether the place lies in it)."""
    column, row = x.floor(), y.floor()
    inside = (row >= 0.0) & (row < size) & (column >= 0.0) & (column < size)
    return torch.where(inside, row * size + column, 0.0).to(torch.int64), inside


Rays = Float64[Tensor, " rays"]
Kernel = Float64[np.ndarray, "size size"]


def trace_lens(
    device: str,
    kernel: Kernel,
    low_px: float,
    high_px: float,
    shares: Float64[np.ndarray, "rays 3"],
    extent: float,
    edges: Float64[np.ndarray, "edges 5"],
    starts: Int64[np.ndarray, " bands_and_end"],
) -> float:
    """See `_simple_lens_numba.trace_lens`."""
    where = device_named(device)
    first, second, third = on(where, shares.T)
    u, v = (2.0 * first - 1.0) * extent, (2.0 * second - 1.0) * extent
    weights = _opening_at(u, v, on(where, edges), on(where, starts), extent, int(np.diff(starts).max()))
    half_px, centre = 0.5 * (low_px + (high_px - low_px) * third), 0.5 * len(kernel)
    return _added(kernel, centre + half_px * u, centre + half_px * v, weights)


def _opening_at(
    x: Rays, y: Rays, edges: Float64[Tensor, "edges 5"], starts: Int64[Tensor, " bands_and_end"], extent: float, most: int
) -> Rays:
    """The first edge of each ray's band, then the second, up to the most that a band has."""
    bands = len(starts) - 1
    band = ((y + extent) * bands / number(2.0 * extent, y)).to(torch.int64).clamp(0, bands - 1)
    start, end = starts[band], starts[band + 1]
    total = torch.zeros_like(x)
    for turn in range(most):
        edge = start + turn
        x0, y0, x1, y1, weight = edges[edge.clamp(max=len(edges) - 1)].unbind(1)
        crossed = (edge < end) & ((y0 > y) != (y1 > y)) & (x < x0 + (y - y0) * (x1 - x0) / (y1 - y0))
        total += torch.where(crossed, weight, 0.0)
    return total


def trace_capsule(device: str, kernel: Kernel, box: Float64[np.ndarray, "2 2"], shares: Float64[np.ndarray, "rays 5"]) -> float:
    """See `_combined_numba.trace_capsule`."""
    first, second, third, fourth, fifth = on(device_named(device), shares.T)
    radius, angle = torch.sqrt(first), 2.0 * math.pi * second
    (low_px, high_px), (shortest_px, longest_px) = box.tolist()
    half_px = 0.5 * (low_px + (high_px - low_px) * third)
    motion_px = shortest_px + (longest_px - shortest_px) * fourth
    centre = 0.5 * len(kernel)
    x = centre + half_px * radius * torch.cos(angle) + motion_px * (fifth - 0.5)
    return _added(kernel, x, centre + half_px * radius * torch.sin(angle), torch.ones_like(x))


def trace_picture(
    device: str,
    kernel: Kernel,
    low_px: float,
    high_px: float,
    shares: Float64[np.ndarray, "rays 3"],
    origin: Float64[np.ndarray, "2"],
    unit: float,
    rows: Float64[np.ndarray, " height_and_end"],
    columns: Float64[np.ndarray, "height width_and_end"],
) -> float:
    """See `_stylized_numba.trace_picture`."""
    where = device_named(device)
    first, second, third = on(where, shares.T)
    y = _inverted(on(where, rows[None]), torch.zeros_like(first, dtype=torch.int64), first)
    x = _inverted(on(where, columns), y.to(torch.int64).clamp(max=len(columns) - 1), second)
    half_px, centre = 0.5 * (low_px + (high_px - low_px) * third) * unit, 0.5 * len(kernel)
    return _added(kernel, centre + half_px * (x - float(origin[0])), centre + half_px * (y - float(origin[1])), torch.ones_like(x))


def _inverted(cumulative: Float64[Tensor, "lines points"], line: Int64[Tensor, " rays"], share: Rays) -> Rays:
    """Where the rising polyline of a ray's line, over 0, 1, 2, ..., reaches its share; found by halving."""
    width = cumulative.shape[1]
    values, start = cumulative.reshape(-1), line * width
    low, high = torch.zeros_like(line), torch.full_like(line, width)
    for _ in range(width.bit_length()):  # values below `low` are at most the share, those from `high` on are more
        middle = (low + high) // 2
        beyond = values[start + middle.clamp(max=width - 1)] > share
        low, high = torch.where(beyond | (low >= high), low, middle + 1), torch.where(beyond, middle, high)
    low = (low - 1).clamp(0, width - 2)
    rise = values[start + low + 1] - values[start + low]
    part = ((share - values[start + low]) / rise).clamp(max=1.0)
    return low + torch.where(rise > 0.0, part, 0.0)


def _added(kernel: Kernel, x: Rays, y: Rays, weights: Rays) -> float:
    """Add rays that land at (x, y), counted from the corner of the kernel; their light."""
    size = len(kernel)
    pixel, inside = pixels(x, y, size)
    light = summed(pixel, torch.where(inside, weights, 0.0), size * size)
    kernel += light.reshape(size, size)
    return float(light.sum())
