"""Sums of points on a device, in whole numbers, and their integration; `add_light_on` stands in for `sums.add_light`.

Integration is by transforms alone: no sweeps along columns, which a GPU has no use for. The operator of
`mrbokeh.renderers.kernels.laplacian_integration.integrate`, with the same borders, is diagonal under a sine transform of the second kind
along rows (continued antisymmetrically about the border) and of the first kind along columns (zeros one pixel beyond).
"""

import math
from collections.abc import Callable, Sequence
from functools import lru_cache, partial

import numpy as np
import torch
from jaxtyping import Float, Float32, Float64, Int32, Int64
from torch import Tensor

from mrbokeh.renderers.kernels.laplacian_tables import Points
from mrbokeh.renderers.spreadlets.sums import Window, window_of
from mrbokeh.renderers.spreadlets.torch_spreadlets._kernels import PointTable, table_of
from mrbokeh.system.errors import InputError
from mrbokeh.system.torch_device import device_named, has_triton

Planes = Float[Tensor, "channels height width"]


def integrate(source: Planes) -> Planes:
    """Return the planes whose 3x3 Laplacian is this, zero beyond the border; in the precision of the source, on its device."""
    _, height, width = source.shape
    if min(height, width) < 3:
        raise InputError(f"a Laplacian to integrate needs at least 3 x 3 pixels, got {width} x {height}")
    modes = _down(_along(source))
    modes *= _inverse(height, width, source.dtype, source.device)
    return _back_along(_down(modes))


@lru_cache(maxsize=8)
def _inverse(height: int, width: int, precision: torch.dtype, device: torch.device) -> Float[Tensor, "height width"]:
    """Return one over the Laplacian of every mode, with the factor of the transforms there and back."""
    down = torch.cos(torch.pi * torch.arange(1, height + 1, dtype=torch.float64) / (height + 1))[:, None]
    right = torch.cos(torch.pi * torch.arange(1, width + 1, dtype=torch.float64) / width)
    eigenvalues = (-20.0 + 8.0 * (right + down) + 4.0 * right * down) / 6.0
    return (1.0 / (eigenvalues * 2.0 * (height + 1))).to(device, precision)


def _down(planes: Planes) -> Planes:
    """Return the sine transform of the first kind along columns; twice it is 2 (height + 1)."""
    border = torch.zeros_like(planes[:, :1])
    odd = torch.cat([border, planes, border, -planes.flip(1)], dim=1)
    return torch.fft.rfft(odd, dim=1).imag[:, 1 : planes.shape[1] + 1].neg()


def _along(planes: Planes) -> Planes:
    """Return the sine transform of the second kind along rows, as a cosine transform of every other pixel negated (Makhoul 1980)."""
    width = planes.shape[2]
    order = torch.cat([planes[..., ::2], -planes[..., 1::2].flip(2)], dim=2)
    half = torch.fft.rfft(order, dim=2) * _turn(width, planes.dtype, planes.device)
    rest = half.imag[..., 1 : (width + 1) // 2].flip(2).neg()
    return torch.cat([half.real, rest], dim=2).flip(2)


def _back_along(modes: Planes) -> Planes:
    """Return the inverse of `_along`."""
    width = modes.shape[2]
    cosine = modes.flip(2)
    beyond = torch.cat([torch.zeros_like(cosine[..., :1]), cosine.flip(2)[..., : width // 2]], dim=2)
    half = torch.complex(cosine[..., : width // 2 + 1].contiguous(), -beyond) * _turn(width, modes.dtype, modes.device).conj()
    order = torch.fft.irfft(half, n=width, dim=2)
    planes = torch.empty_like(modes)
    planes[..., ::2] = order[..., : (width + 1) // 2]
    planes[..., 1::2] = -order[..., (width + 1) // 2 :].flip(2)
    return planes


@lru_cache(maxsize=8)
def _turn(width: int, precision: torch.dtype, device: torch.device) -> Tensor:
    angle = -0.5 * torch.pi * torch.arange(width // 2 + 1, dtype=torch.float64) / width
    return torch.polar(torch.ones_like(angle), angle).to(device, torch.complex128 if precision == torch.float64 else torch.complex64)


AT_ONCE = {"cpu": 1 << 14, "cuda": 1 << 21}
"""Points that are splatted at a time without a kernel: what caches hold, or what keeps a GPU busy with some 400 MB."""
_BITS = 61
_MOST_NUMBERED = 1 << 31  # the kernel counts in 32 bits

Light = Float32[Tensor, "height width channels"]
Cells = Int32[Tensor, "height width"]


def splat(
    values: Light, cells: Cells, table: PointTable, window: Window, largest: float, colours: Sequence[int] = ()
) -> Float64[Tensor, "channels rows columns"]:
    """Return the sums over all pixels with a cell (>= 0) within a window that all points fall into, the same bits on every device.

    largest: no value is larger, without its sign. colours: the column of weights that each channel takes; () is the first.
    """
    if not math.isfinite(largest):
        raise InputError(f"light must be finite, but the brightest pixel is {largest}: clean the picture of inf and NaN")
    bound = max(largest * table.largest_sum, 1e-200)
    exponent = _BITS - math.frexp(bound)[1]
    sums = torch.zeros((window.height, window.width, values.shape[2]), dtype=torch.int64, device=values.device)
    task = sums, values, cells, table, window, math.ldexp(1.0, exponent), colours or (0,) * values.shape[2]
    if values.device.type == "cuda" and has_triton() and sums.numel() < _MOST_NUMBERED:
        from mrbokeh.renderers.spreadlets.torch_spreadlets._splat_triton import splat_by_kernel

        splat_by_kernel(*task)
    else:
        splat_in_chunks(*task)
    return sums.permute(2, 0, 1).to(torch.float64, memory_format=torch.contiguous_format).mul_(math.ldexp(1.0, -exponent))


def splat_in_chunks(
    sums: Int64[Tensor, "rows columns channels"],
    values: Light,
    cells: Cells,
    table: PointTable,
    window: Window,
    scale: float,
    colours: Sequence[int],
    at_once: int = 0,
) -> None:
    """Add round(scale * weight * light) to sums: all points of some pixels at a time, on any device of torch."""
    channels = torch.arange(values.shape[2], device=values.device)
    pixels = torch.nonzero(cells.reshape(-1) >= 0)[:, 0]
    cell = cells.reshape(-1)[pixels].long()
    count, first = table.count.long()[cell], table.first.long()[cell]
    light = values.reshape(-1, len(channels))[pixels].double()
    base = (pixels // cells.shape[1] - window.top) * window.width + pixels % cells.shape[1] - window.left
    shift, weights = table.xy[:, 1].long() * window.width + table.xy[:, 0], table.weights * scale
    ends = torch.cumsum(count, 0)
    for begin, end in _chunks(ends.cpu(), at_once or AT_ONCE[values.device.type]):
        who = torch.repeat_interleave(count[begin:end]) + begin
        point = torch.arange(len(who), device=who.device) + (first - ends + count)[who] + (ends - count)[begin]
        weight = weights[point] if weights.shape[1] == 1 else weights[point][:, list(colours)]
        target = (base[who] + shift[point])[:, None] * len(channels) + channels
        sums.view(-1).index_add_(0, target.view(-1), rounded(light[who] * weight).view(-1))


def rounded(number: Float64[Tensor, "*batch"]) -> Int64[Tensor, "*batch"]:
    """Round to the nearest whole number, halves upwards; the Triton kernel does the same."""
    return torch.floor(number + 0.5).to(torch.int64)


def _chunks(ends: Int64[Tensor, " pixels"], at_once: int) -> list[tuple[int, int]]:
    """Return first and end of runs of pixels with at most so many points together, or of single pixels."""
    chunks, begin, before = [], 0, 0
    while begin < len(ends):
        end = max(int(torch.searchsorted(ends, before + at_once, right=True)), begin + 1)
        chunks.append((begin, end))
        begin, before = end, int(ends[end - 1])
    return chunks


def add_light_on(device: str) -> Callable[..., None]:
    """Return the stand-in for `add_light` on a device: same arguments, same windows, and the same result to rounding."""
    return partial(_add_light, device_named(device))


def _add_light(
    device: torch.device,
    out: Float32[np.ndarray, "height width channels"],
    values: Float32[np.ndarray, "height width channels"],
    cells: Int32[np.ndarray, "height width"],
    points: Points,
    integration: str | None,
    threads: int = 0,  # noqa: ARG001
) -> None:
    if integration == "pyramid":
        raise InputError("on a device a Laplacian is integrated by 'exact', got 'pyramid': leave it out, or leave out the device")
    window = window_of(cells, points.reach_px, integration is not None)
    light, where = torch.from_numpy(np.ascontiguousarray(values)).to(device), torch.from_numpy(cells).to(device)
    sums = splat(light, where, table_of(points, device), window, float(np.abs(values).max()))
    if integration is not None:
        sums = integrate(sums)
    height, width, _ = out.shape
    y0, x0 = max(0, window.top), max(0, window.left)
    y1, x1 = min(height, window.top + window.height), min(width, window.left + window.width)
    inside = sums[:, y0 - window.top : y1 - window.top, x0 - window.left : x1 - window.left]
    out[y0:y1, x0:x1] += inside.permute(1, 2, 0).float().cpu().numpy()
