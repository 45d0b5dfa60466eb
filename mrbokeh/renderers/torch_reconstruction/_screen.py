"""Screen-space filters of many jobs at once: every filter is a kernel, and meets its window in a Fourier transform.

A window holds zeros beyond what its job reads, and is so much larger than the tile that nothing comes around. Single
precision would leave 1e-7 of the largest value on all pixels, which is light where there is none, and where weights are next to
nothing their quotients would be chance. In double precision a lamp of 1e5 leaves 1e-11.
"""

import math

import torch
from jaxtyping import Float32, Float64, Int64
from torch import Tensor

from mrbokeh.aperture import Aperture
from mrbokeh.errors import InputError
from mrbokeh.renderers.layered_reconstruction._settings import Settings
from mrbokeh.renderers.torch_reconstruction._filter import Slopes, Spread, screen_covariance
from mrbokeh.renderers.torch_reconstruction._gaussians import direct_kernels, gaussian_guards, less_pixel, recursive_rows, sheared_kernels
from mrbokeh.renderers.torch_reconstruction._jobs import Jobs, Task
from mrbokeh.renderers.torch_reconstruction._light import TileLight
from mrbokeh.renderers.torch_reconstruction._windows import PupilTables, line_kernels, pupil_kernels, rest_kernel, window_guards

FILTERS = ("windows", "sheared", "direct")
_BEYOND = 2
"""Pixels by which transforms are larger than windows: linear interpolation reads one further."""


class ScreenFilter:
    """One of FILTERS. aperture: the opening in its true shape, for "windows"."""

    def __init__(self, settings: Settings, aperture: Aperture, light: TileLight) -> None:
        if settings.screen_filter not in FILTERS:
            raise InputError(
                f"on a device the screen filter is one of {', '.join(FILTERS)}, got {settings.screen_filter!r}: "
                "take one of these, or leave out the device"
            )
        self.settings, self.window, self.pupil_radius = settings, light.window, light.pupil_radius
        self.tables = PupilTables.of(aperture, light.window.device) if settings.screen_filter == "windows" else None

    def guards(self, slopes: Slopes) -> Int64[Tensor, "jobs 2"]:
        """How many pixels beyond a tile the filter of each job reads, along x and y."""
        if self.tables is not None:
            return window_guards(slopes, self.pupil_radius, self.settings.sigma_x_px)
        return gaussian_guards(self._covariance(slopes), self.settings.support)

    def filtered(
        self, planes: Float32[Tensor, "group side side planes"], jobs: Jobs, task: Task, guard: int
    ) -> Float32[Tensor, "group planes tile tile"]:
        """What of the windows comes to lie on the tiles in their middles."""
        slopes = Slopes(*(each[task.job] for each in jobs.slopes))
        values = planes.permute(0, 3, 1, 2)
        size = transform_size(task.side + _BEYOND)
        offset = torch.arange(size, device=planes.device)
        offset = torch.where(offset > size // 2, offset - size, offset)
        if self.settings.screen_filter == "sheared":
            values = recursive_rows(values, self._covariance(slopes), task, jobs.guard[task.job], self.settings.recursive_passes)
        spectrum = torch.fft.rfft2(values.double(), s=(size, size))
        kernels = [torch.fft.rfft2(kernel) for kernel in self._kernels(slopes, jobs.guard[task.job], offset)]
        spectrum *= math.prod(kernels[1:], start=kernels[0]).conj()[:, None]
        tile = slice(guard, task.side - guard)
        return torch.fft.irfft2(spectrum, s=(size, size))[..., tile, tile].float()

    def _kernels(
        self, slopes: Slopes, guard: Int64[Tensor, "group 2"], offset: Int64[Tensor, " size"]
    ) -> list[Float64[Tensor, "group size size"]]:
        if self.tables is not None:
            parts = [line_kernels(slopes, offset), pupil_kernels(slopes, self.tables, offset)]
            rest = rest_kernel(self.settings.sigma_x_px, offset)
            return parts if rest is None else [*parts, rest.expand_as(parts[0])]
        covariance = self._covariance(slopes)
        make = sheared_kernels if self.settings.screen_filter == "sheared" else direct_kernels
        return [make(covariance, guard, offset)]

    def _covariance(self, slopes: Slopes) -> Spread:
        return less_pixel(screen_covariance(slopes, self.window, self.settings.sigma_x_px))


def transform_size(least: int) -> int:
    """The least product of 2, 3 and 5 that is even and no smaller."""
    size = least + least % 2
    while True:
        rest = size
        for prime in (2, 3, 5):
            while rest % prime == 0:
                rest //= prime
        if rest == 1:
            return size
        size += 2
