"""Arrays that go to a device of torch, and light that is added up in bins there."""

import math

import numpy as np
import torch
from jaxtyping import Bool, Float64, Int64, Shaped
from torch import Tensor

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
