"""Gaussians over the screen, in place of pupil and shutter: the sheared recursive filter (Eq. 9 and 10) and its slow twin."""

import torch
from jaxtyping import Float32, Float64, Int64
from torch import Tensor

from mrbokeh.renderers.layered_reconstruction._filter_numba import PIXEL_VARIANCE
from mrbokeh.renderers.layered_reconstruction.torch_reconstruction._filter import Number, Spread, axes, sheared_axes
from mrbokeh.renderers.layered_reconstruction.torch_reconstruction._jobs import Task
from mrbokeh.renderers.layered_reconstruction.torch_reconstruction._windows import Kernels, Offsets

_LEAST_VARIANCE = 1e-4
_LEAST_RECURSIVE_VARIANCE = 1e-3
_WITHIN_A_PIXEL = 0.04
_LEAST_WEIGHT = 1e-6


def less_pixel(v: Spread) -> Spread:
    """The covariance without what a pixel as a bin adds."""
    return Spread((v.xx - PIXEL_VARIANCE).clamp(min=_LEAST_VARIANCE), v.xy, (v.yy - PIXEL_VARIANCE).clamp(min=_LEAST_VARIANCE))


def gaussian_guards(v: Spread, support: float) -> Int64[Tensor, "jobs 2"]:
    """Pixels beyond the tile along x and y; a Gaussian that ends within its pixel needs none."""
    both = torch.stack([v.xx, v.yy], dim=1)
    return torch.where(both > _WITHIN_A_PIXEL, torch.ceil(support * torch.sqrt(both)), 0.0).long()


def direct_kernels(v: Spread, guard: Int64[Tensor, "group 2"], offset: Offsets) -> Kernels:
    """The Gaussian sampled at pixels, sum 1."""
    x, y = offset[None, None, :].double(), offset[None, :, None].double()
    xx, xy, yy = (each[:, None, None] for each in v)
    det = xx * yy - xy * xy
    kernel = torch.exp(-0.5 * (yy * x * x - 2.0 * xy * x * y + xx * y * y) / det.clamp(min=1e-300))
    kernel = kernel * _inside(guard, offset)
    point = ((offset == 0)[:, None] & (offset == 0)).double()
    return torch.where((det > 1e-9) & (guard.amax(dim=1) > 0)[:, None, None], kernel / kernel.sum(dim=(1, 2), keepdim=True), point)


def sheared_kernels(v: Spread, guard: Int64[Tensor, "group 2"], offset: Offsets) -> Kernels:
    """The plain Gaussian along (beta, 1), linear between the pixels of a row; a Gaussian within its pixel is a point."""
    weights, beta = _sheared_weights(v, guard, offset)
    tent = (1.0 - (offset - beta[:, None, None] * offset[None, :, None]).abs()).clamp(min=0.0)
    weights = torch.where(weights < _LEAST_WEIGHT, 0.0, weights)
    return weights[:, :, None] * tent


def recursive_rows(
    planes: Float32[Tensor, "group planes side side2"], v: Spread, task: Task, guard: Int64[Tensor, "group 2"], passes: int
) -> Float32[Tensor, "group planes side side2"]:
    """Eq. 10 along x, beyond the borders of each job nothing.

    Forward and backward together weigh what lies n pixels away with gain gamma^|n|; as a matrix that is one product for all rows.
    """
    variance, is_point = _variance_along_x(v, guard)
    gamma = torch.where(is_point, 0.0, feedback(variance / passes))[:, None, None]
    at = torch.arange(task.side, device=planes.device)
    low, high, is_sharp = task.facts[:, 2:3], task.facts[:, 4:5], task.facts[:, 6:7]
    inside = (at >= low) & (at < high + 1 - is_sharp)
    matrix = (1.0 - gamma) / (1.0 + gamma) * gamma ** (at[:, None] - at).abs()
    matrix = (matrix * (inside[:, :, None] & inside[:, None, :])).float()
    rows = planes.reshape(len(planes), -1, task.side)
    for _ in range(passes):
        rows = rows @ matrix
    return rows.view(planes.shape)


def feedback(variance_px2: Number) -> Number:
    """gamma of Eq. 10, such that forward and backward together have exactly this variance, 2 gamma / (1 - gamma)^2."""
    q = 1.0 + 1.0 / variance_px2
    return q - torch.sqrt(q * q - 1.0)


def _variance_along_x(v: Spread, guard: Int64[Tensor, "group 2"]) -> tuple[Number, Tensor]:
    """What is left for the filter along x once linear interpolation has added its own, and where that is nothing."""
    most = int(guard.amax())
    offset = torch.arange(-most, most + 1, device=guard.device)
    s_u, _, _ = sheared_axes(*axes(v))
    weights, beta = _sheared_weights(v, guard, offset)
    part = beta[:, None] * offset
    part = part - torch.floor(part)
    variance = s_u**2 - (weights * part * (1.0 - part)).sum(dim=1)
    is_point = (variance < _LEAST_RECURSIVE_VARIANCE) | (guard.amax(dim=1) == 0)
    return torch.where(is_point, 1.0, variance), is_point


def _sheared_weights(v: Spread, guard: Int64[Tensor, "group 2"], offset: Offsets) -> tuple[Float64[Tensor, "group size"], Number]:
    """Weights of rows along the sheared axis, and its beta."""
    _, s_v, beta = sheared_axes(*axes(v))
    is_point = (s_v <= 1e-3) | (guard.amax(dim=1) == 0)
    weights = torch.exp(-0.5 * (offset / s_v.clamp(min=1e-3)[:, None]) ** 2) * (offset.abs() <= guard[:, 1:])
    weights = torch.where(is_point[:, None], (offset == 0).double(), weights)
    return weights / weights.sum(dim=1, keepdim=True), beta


def _inside(guard: Int64[Tensor, "group 2"], offset: Offsets) -> Tensor:
    return (offset.abs() <= guard[:, :1])[:, None, :] & (offset.abs() <= guard[:, 1:])[:, :, None]
