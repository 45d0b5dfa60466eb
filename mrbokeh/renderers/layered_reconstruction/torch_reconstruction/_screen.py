"""Screen-space filters of many jobs at once: every filter is a kernel, and meets its window in a Fourier transform.

A window holds zeros beyond what its job reads, and is so much larger than the tile that nothing comes around. Single
precision would leave 1e-7 of the largest value on all pixels, which is light where there is none, and where weights are next to
nothing their quotients would be chance. In double precision a lamp of 1e5 leaves 1e-11.
"""

from collections.abc import Iterator
from itertools import pairwise

import torch
from jaxtyping import Complex128, Float32, Int64
from torch import Tensor
from torch.nn.functional import avg_pool2d, pad

from mrbokeh.optics.aperture import Aperture
from mrbokeh.renderers.layered_reconstruction._settings import Settings
from mrbokeh.renderers.layered_reconstruction._tiles_numba import COARSE_PX
from mrbokeh.renderers.layered_reconstruction.torch_reconstruction._jobs import Jobs, Task
from mrbokeh.renderers.layered_reconstruction.torch_reconstruction._kernels import (
    PupilTables,
    direct_kernels,
    gaussian_guards,
    less_pixel,
    line_kernels,
    pupil_kernels,
    recursive_rows,
    rest_kernel,
    sheared_kernels,
    window_guards,
)
from mrbokeh.renderers.layered_reconstruction.torch_reconstruction._light import TileLight
from mrbokeh.renderers.layered_reconstruction.torch_reconstruction._statistics import Covariance, Slopes, screen_covariance
from mrbokeh.system.errors import InputError

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
