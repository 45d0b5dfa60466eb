"""Screen-space filters of many jobs at once: every filter is a kernel, and meets its window in a Fourier transform.

A window holds zeros beyond what its job reads, and is so much larger than the tile that nothing comes around. Single
precision would leave 1e-7 of the largest value on all pixels, which is light where there is none, and where weights are next to
nothing their quotients would be chance. In double precision a lamp of 1e5 leaves 1e-11.

Kernels are pupil and shutter in their true shapes, as in `layered_reconstruction._windows_numba`, or Gaussians in their place: the
recursive ones of Eq. 9 and 10, and their slow twin.
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import torch
from jaxtyping import Complex128, Float32, Float64, Int64
from torch import Tensor
from torch.nn.functional import avg_pool2d, pad

from mrbokeh.optics.aperture import Aperture
from mrbokeh.renderers.layered_reconstruction._filter_numba import PIXEL_VARIANCE
from mrbokeh.renderers.layered_reconstruction._settings import Settings
from mrbokeh.renderers.layered_reconstruction._tile_data import packed_pupil
from mrbokeh.renderers.layered_reconstruction._tiles_numba import COARSE_PX
from mrbokeh.renderers.layered_reconstruction._windows_numba import LEAST_SCALE_PX, STRIPS_FOR_PX
from mrbokeh.renderers.layered_reconstruction.torch_reconstruction._jobs import Jobs, Task
from mrbokeh.renderers.layered_reconstruction.torch_reconstruction._light import TileLight
from mrbokeh.renderers.layered_reconstruction.torch_reconstruction._statistics import (
    Covariance,
    Number,
    Slopes,
    axes,
    screen_covariance,
    sheared_axes,
)
from mrbokeh.system.errors import InputError

_LEAST_VARIANCE = 0.04
_LEAST_SHARE = 1e-6

Kernels = Float64[Tensor, "group size size"]
Offsets = Int64[Tensor, " size"]


@dataclass(frozen=True)
class PupilTables:
    """Drawings of the opening or of a cell of it, coarse to fine, first as seen in front of the focus: (D, S, 5) strips, filled up with
    empty ones. share: of the light that comes through."""

    strips: Float64[Tensor, "drawings strips 5"]
    share: float

    @classmethod
    def of(cls, aperture: Aperture, device: torch.device) -> "PupilTables":
        return cls.in_cells(aperture, device, 1)[0]

    @classmethod
    def in_cells(cls, aperture: Aperture, device: torch.device, across: int) -> "list[PupilTables]":
        spans, starts, shares = packed_pupil(aperture, across)
        table = np.zeros((len(starts) - 1, int(np.diff(starts).max()), 5))
        table[..., 2] = 1.0
        for k in range(len(table)):
            own = spans[starts[k] : starts[k + 1]]
            table[k, : len(own)] = own
        return [cls(torch.from_numpy(table[k :: len(shares)].copy()).to(device), share) for k, share in enumerate(shares.tolist())]

    def drawing(self, scale: Number) -> Float64[Tensor, "group strips 5"]:
        """Return the strips that do for pupils of these radii in pixels."""
        finest = len(self.strips) // 2 - 1
        level = torch.ceil(torch.log2((scale.abs() / STRIPS_FOR_PX).clamp(min=1.0))).long().clamp(max=finest)
        return self.strips[level + torch.where(scale > 0.0, finest + 1, 0)]


def drawn_sizes(slopes: Slopes) -> tuple[Number, Number, Number]:
    """Return the radius of the pupil's picture, negative in front of the focus, and the segment of the shutter, x and y, in pixels."""
    scale = slopes.r * torch.sqrt(slopes.kappa_u * (2.0 - slopes.kappa_u))
    share = torch.sqrt(slopes.kappa_t * (2.0 - slopes.kappa_t))
    return scale, share * slopes.m_x, share * slopes.m_y


def window_guards(slopes: Slopes, pupil_radius: float, sigma_x_px: float) -> Int64[Tensor, "jobs 2"]:
    """Return guard bands along x and y of segment, pupil and spatial filter together."""
    scale, length_x, length_y = drawn_sizes(slopes)
    pupil = torch.ceil(scale.abs() * pupil_radius) + 1.0 + _rest_reach(sigma_x_px)
    return torch.stack([torch.ceil(0.5 * length.abs()) + pupil for length in (length_x, length_y)], dim=1).long()


def line_kernels(slopes: Slopes, offset: Offsets, begin: float = -0.5, end: float = 0.5) -> Kernels:
    """Return segments centred on a pixel, from one time to another, shared out among pixels by the length within each.

    What lies at x0 is carried to x0 + length t, so the light of a pixel is read around x - length t.
    """
    _, length_x, length_y = drawn_sizes(slopes)
    low_x, high_x = _times_within(-length_x, offset, begin, end)
    low_y, high_y = _times_within(-length_y, offset, begin, end)
    low, high = torch.maximum(low_x[:, None, :], low_y[:, :, None]), torch.minimum(high_x[:, None, :], high_y[:, :, None])
    return (high - low).clamp(min=0.0) / (end - begin)


def _times_within(
    length: Number, offset: Offsets, begin: float, end: float
) -> tuple[Float64[Tensor, "group size"], Float64[Tensor, "group size"]]:
    """Return from when to when, between begin and end, a segment is in the pixels of each offset along one axis; without bounds if it
    stays.
    """
    one, other = (offset - 0.5) / length[:, None], (offset + 0.5) / length[:, None]
    return torch.minimum(one, other).clamp(min=begin), torch.maximum(one, other).clamp(max=end)


def pupil_kernels(slopes: Slopes, tables: PupilTables, offset: Offsets) -> Kernels:
    """Return the pupil's picture in strips, shared out among pixels by area; a very small one is a point.

    What lies at x0 is thrown to x0 + scale u, so the light of a pixel is read around x - scale u.
    """
    scale, _, _ = drawn_sizes(slopes)
    is_point = scale.abs() < LEAST_SCALE_PX
    scale = torch.where(is_point, 1.0, scale)[:, None]
    v, first_u, last_u, weight, height = tables.drawing(scale[:, 0]).unbind(dim=2)
    half = 0.5 * scale.abs() * height
    down = _covered(-scale * v - half, -scale * v + half, offset)
    across = _covered(torch.minimum(-scale * first_u, -scale * last_u), torch.maximum(-scale * first_u, -scale * last_u), offset)
    down = torch.where(down > _LEAST_SHARE, down, 0.0)
    kernel = down.transpose(1, 2) @ (across * weight[:, :, None])
    point = ((offset == 0)[:, None] & (offset == 0)).double()
    return torch.where(is_point[:, None, None], point, kernel)


def _covered(
    low: Float64[Tensor, "group strips"], high: Float64[Tensor, "group strips"], offset: Offsets
) -> Float64[Tensor, "group strips size"]:
    """Return the share of each stretch, relative to the centre of a pixel, that lies on the pixel of each offset."""
    start = torch.maximum(low[..., None], offset - 0.5)
    end = torch.minimum(high[..., None], offset + 0.5)
    return (end - start).clamp(min=0.0) / (high - low).clamp(min=1e-12)[..., None]


def _rest_reach(sigma_x_px: float) -> int:
    variance = sigma_x_px**2 - PIXEL_VARIANCE
    return math.ceil(3.0 * math.sqrt(variance)) if variance >= _LEAST_VARIANCE else 0


def rest_kernel(sigma_x_px: float, offset: Offsets) -> Float64[Tensor, "size size"] | None:
    """Return what the spatial filter has beyond a pixel, an even Gaussian; None if that is no wider than a pixel."""
    reach = _rest_reach(sigma_x_px)
    if reach == 0:
        return None
    taps = torch.exp(-0.5 * offset.double() ** 2 / (sigma_x_px**2 - PIXEL_VARIANCE)) * (offset.abs() <= reach)
    taps = taps / taps.sum()
    return taps[:, None] * taps


_LEAST_GAUSSIAN_VARIANCE = 1e-4
_LEAST_RECURSIVE_VARIANCE = 1e-3
_WITHIN_A_PIXEL = 0.04
_LEAST_WEIGHT = 1e-6


def less_pixel(v: Covariance) -> Covariance:
    """Return the covariance without what a pixel as a bin adds."""
    return Covariance(
        (v.xx - PIXEL_VARIANCE).clamp(min=_LEAST_GAUSSIAN_VARIANCE), v.xy, (v.yy - PIXEL_VARIANCE).clamp(min=_LEAST_GAUSSIAN_VARIANCE)
    )


def gaussian_guards(v: Covariance, support: float) -> Int64[Tensor, "jobs 2"]:
    """Return pixels beyond the tile along x and y; a Gaussian that ends within its pixel needs none."""
    both = torch.stack([v.xx, v.yy], dim=1)
    return torch.where(both > _WITHIN_A_PIXEL, torch.ceil(support * torch.sqrt(both)), 0.0).long()


def direct_kernels(v: Covariance, guard: Int64[Tensor, "group 2"], offset: Offsets) -> Kernels:
    """Return the Gaussian sampled at pixels, sum 1."""
    x, y = offset[None, None, :].double(), offset[None, :, None].double()
    xx, xy, yy = (each[:, None, None] for each in v)
    det = xx * yy - xy * xy
    kernel = torch.exp(-0.5 * (yy * x * x - 2.0 * xy * x * y + xx * y * y) / det.clamp(min=1e-300))
    kernel = kernel * _inside(guard, offset)
    point = ((offset == 0)[:, None] & (offset == 0)).double()
    return torch.where((det > 1e-9) & (guard.amax(dim=1) > 0)[:, None, None], kernel / kernel.sum(dim=(1, 2), keepdim=True), point)


def sheared_kernels(v: Covariance, guard: Int64[Tensor, "group 2"], offset: Offsets) -> Kernels:
    """Return the plain Gaussian along (beta, 1), linear between the pixels of a row; a Gaussian within its pixel is a point."""
    weights, beta = _sheared_weights(v, guard, offset)
    tent = (1.0 - (offset - beta[:, None, None] * offset[None, :, None]).abs()).clamp(min=0.0)
    weights = torch.where(weights < _LEAST_WEIGHT, 0.0, weights)
    return weights[:, :, None] * tent


def recursive_rows(
    planes: Float32[Tensor, "group planes side side2"], v: Covariance, task: Task, guard: Int64[Tensor, "group 2"], passes: int
) -> Float32[Tensor, "group planes side side2"]:
    """Filter by Eq. 10 along x, with nothing beyond the borders of each job.

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
    """Return gamma of Eq. 10, such that forward and backward together have exactly this variance, 2 gamma / (1 - gamma)^2."""
    q = 1.0 + 1.0 / variance_px2
    return q - torch.sqrt(q * q - 1.0)


def _variance_along_x(v: Covariance, guard: Int64[Tensor, "group 2"]) -> tuple[Number, Tensor]:
    """Return the variance left for the filter along x once linear interpolation has added its own, and where nothing is left."""
    most = int(guard.amax())
    offset = torch.arange(-most, most + 1, device=guard.device)
    s_u, _, _ = sheared_axes(*axes(v))
    weights, beta = _sheared_weights(v, guard, offset)
    part = beta[:, None] * offset
    part = part - torch.floor(part)
    variance = s_u**2 - (weights * part * (1.0 - part)).sum(dim=1)
    is_point = (variance < _LEAST_RECURSIVE_VARIANCE) | (guard.amax(dim=1) == 0)
    return torch.where(is_point, 1.0, variance), is_point


def _sheared_weights(v: Covariance, guard: Int64[Tensor, "group 2"], offset: Offsets) -> tuple[Float64[Tensor, "group size"], Number]:
    """Return weights of rows along the sheared axis, and its beta."""
    _, s_v, beta = sheared_axes(*axes(v))
    is_point = (s_v <= 1e-3) | (guard.amax(dim=1) == 0)
    weights = torch.exp(-0.5 * (offset / s_v.clamp(min=1e-3)[:, None]) ** 2) * (offset.abs() <= guard[:, 1:])
    weights = torch.where(is_point[:, None], (offset == 0).double(), weights)
    return weights / weights.sum(dim=1, keepdim=True), beta


def _inside(guard: Int64[Tensor, "group 2"], offset: Offsets) -> Tensor:
    return (offset.abs() <= guard[:, :1])[:, None, :] & (offset.abs() <= guard[:, 1:])[:, :, None]


FILTERS = ("windows", "sheared", "direct")
_BEYOND = 2
"""Pixels by which transforms are larger than windows: linear interpolation reads one further."""


class ScreenFilter:
    """Screen-space filter, one of FILTERS. aperture: the opening in its true shape, for "windows"."""

    def __init__(self, settings: Settings, aperture: Aperture, light: TileLight) -> None:
        if settings.screen_filter not in FILTERS:
            raise InputError(
                f"on a device the screen filter is one of {', '.join(FILTERS)}, got {settings.screen_filter!r}: "
                "take one of these, or leave out the device"
            )
        self.settings, self.window, self.pupil_radius = settings, light.window, light.pupil_radius
        across, self.times = settings.parts
        self.whole = PupilTables.of(aperture, light.window.device) if settings.screen_filter == "windows" else None
        self.cells = PupilTables.in_cells(aperture, light.window.device, across) if self.whole else []
        self.shares = [cell.share / self.times for cell in self.cells for _ in range(self.times)] or [1.0]

    def guards(self, slopes: Slopes) -> Int64[Tensor, "jobs 2"]:
        """Return how many pixels beyond a tile the filter of each job reads, along x and y."""
        if self.whole is not None:
            return window_guards(slopes, self.pupil_radius, self.settings.sigma_x_px)
        return gaussian_guards(self._covariance(slopes), self.settings.support)

    def filtered(
        self, planes: Float32[Tensor, "group side side planes"], jobs: Jobs, task: Task, guard: int, in_parts: bool
    ) -> Float32[Tensor, "group planes parts tile tile"]:
        """Filter windows and return the tiles in their middles, through each part of pupil and shutter or through all."""
        slopes = Slopes(*(each[task.job] for each in jobs.slopes))
        values = planes.permute(0, 3, 1, 2)
        size = transform_size(task.side + _BEYOND)
        offset = _offsets(size, planes.device)
        if self.settings.screen_filter == "sheared":
            values = recursive_rows(values, self._covariance(slopes), task, jobs.guard[task.job], self.settings.recursive_passes)
        spectrum = torch.fft.rfft2(values.double(), s=(size, size))
        tile = slice(guard, task.side - guard)
        return _met(spectrum, self._spectra(slopes, jobs.guard[task.job], offset, in_parts), tile, size)

    def filtered_coarse(
        self, planes: Float32[Tensor, "group side side planes"], jobs: Jobs, task: Task, guard: int, in_parts: bool
    ) -> Float32[Tensor, "group planes parts coarse coarse"]:
        """Return the same in pixels COARSE_PX as large."""
        slopes = Slopes(*(each[task.job] for each in jobs.slopes))
        slopes = slopes._replace(r=slopes.r / COARSE_PX, m_x=slopes.m_x / COARSE_PX, m_y=slopes.m_y / COARSE_PX)
        wider = -guard % COARSE_PX
        values = pad(self._smoothed(planes.permute(0, 3, 1, 2)), (wider,) * 4)
        small, guard = avg_pool2d(values, COARSE_PX), (guard + wider) // COARSE_PX
        size = transform_size(small.shape[-1] + _BEYOND)
        spectrum = torch.fft.rfft2(small.double(), s=(size, size))
        offset, tile = _offsets(size, planes.device), slice(guard, small.shape[-1] - guard)
        return _met(spectrum, self._windows(slopes, offset, in_parts), tile, size)

    def _smoothed(self, values: Float32[Tensor, "group planes side side"]) -> Float32[Tensor, "group planes side side"]:
        """Smooth by what the spatial filter has beyond a pixel."""
        side = values.shape[-1]
        size = transform_size(side + _BEYOND)
        rest = rest_kernel(self.settings.sigma_x_px, _offsets(size, values.device))
        if rest is None:
            return values
        spectrum = torch.fft.rfft2(values.double(), s=(size, size)) * torch.fft.rfft2(rest).conj()
        return torch.fft.irfft2(spectrum, s=(size, size))[..., :side, :side].float()

    def _spectra(
        self, slopes: Slopes, guard: Int64[Tensor, "group 2"], offset: Int64[Tensor, " size"], in_parts: bool
    ) -> Iterator[Complex128[Tensor, "group size half"]]:
        """Yield the spectrum of each part's filter: cell by cell of the pupil, time by time within each."""
        if self.whole is None:
            make = sheared_kernels if self.settings.screen_filter == "sheared" else direct_kernels
            yield torch.fft.rfft2(make(self._covariance(slopes), guard, offset))
            return
        rest = rest_kernel(self.settings.sigma_x_px, offset)
        for window in self._windows(slopes, offset, in_parts):
            yield window if rest is None else window * torch.fft.rfft2(rest)

    def _windows(self, slopes: Slopes, offset: Int64[Tensor, " size"], in_parts: bool) -> Iterator[Complex128[Tensor, "group size half"]]:
        """Yield the spectra of pupil and shutter in their true shapes."""
        cells, times = (self.cells, self.times) if in_parts or self.whole is None else ([self.whole], 1)
        borders = [time / times - 0.5 for time in range(times + 1)]
        lines = [torch.fft.rfft2(line_kernels(slopes, offset, begin, end)) for begin, end in pairwise(borders)]
        for cell in cells:
            pupil = torch.fft.rfft2(pupil_kernels(slopes, cell, offset))
            for line in lines:
                yield line * pupil

    def _covariance(self, slopes: Slopes) -> Covariance:
        return less_pixel(screen_covariance(slopes, self.window, self.settings.sigma_x_px))


def _offsets(size: int, device: torch.device) -> Int64[Tensor, " size"]:
    offset = torch.arange(size, device=device)
    return torch.where(offset > size // 2, offset - size, offset)


def _met(
    spectrum: Complex128[Tensor, "group planes size half"], kernels: Iterator[Complex128[Tensor, "group size half"]], tile: slice, size: int
) -> Float32[Tensor, "group planes parts tile tile"]:
    """Return the part of the products with each kernel that lies on the tile."""
    parts = [
        torch.fft.irfft(torch.fft.ifft(spectrum * kernel.conj()[:, None], dim=-2)[..., tile, :], n=size)[..., tile].float()
        for kernel in kernels
    ]
    return torch.stack(parts, dim=2)


def transform_size(least: int) -> int:
    """Return the least product of 2, 3 and 5 that is even and no smaller."""
    size = least + least % 2
    while True:
        rest = size
        for prime in (2, 3, 5):
            while rest % prime == 0:
                rest //= prime
        if rest == 1:
            return size
        size += 2
