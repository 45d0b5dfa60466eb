"""The true shapes of pupil and shutter over the screen, as kernels of pixels: `layered_reconstruction._window_numba` for many jobs."""

import math
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float64, Int64
from torch import Tensor

from mrbokeh.optics.aperture import Aperture
from mrbokeh.renderers.layered_reconstruction._filter_numba import PIXEL_VARIANCE
from mrbokeh.renderers.layered_reconstruction._pupil_spans import packed_pupil
from mrbokeh.renderers.layered_reconstruction._window_numba import LEAST_SCALE_PX, STRIPS_FOR_PX
from mrbokeh.renderers.layered_reconstruction.torch_reconstruction._filter import Number, Slopes

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
        """The strips that do for pupils of these radii in pixels."""
        finest = len(self.strips) // 2 - 1
        level = torch.ceil(torch.log2((scale.abs() / STRIPS_FOR_PX).clamp(min=1.0))).long().clamp(max=finest)
        return self.strips[level + torch.where(scale > 0.0, finest + 1, 0)]


def drawn_sizes(slopes: Slopes) -> tuple[Number, Number, Number]:
    """Radius of the pupil's picture, negative in front of the focus, and the segment of the shutter, x and y, in pixels."""
    scale = slopes.r * torch.sqrt(slopes.kappa_u * (2.0 - slopes.kappa_u))
    share = torch.sqrt(slopes.kappa_t * (2.0 - slopes.kappa_t))
    return scale, share * slopes.m_x, share * slopes.m_y


def window_guards(slopes: Slopes, pupil_radius: float, sigma_x_px: float) -> Int64[Tensor, "jobs 2"]:
    """Guard bands along x and y of segment, pupil and spatial filter together."""
    scale, length_x, length_y = drawn_sizes(slopes)
    pupil = torch.ceil(scale.abs() * pupil_radius) + 1.0 + _rest_reach(sigma_x_px)
    return torch.stack([torch.ceil(0.5 * length.abs()) + pupil for length in (length_x, length_y)], dim=1).long()


def line_kernels(slopes: Slopes, offset: Offsets, begin: float = -0.5, end: float = 0.5) -> Kernels:
    """Segments centred on a pixel, from one time to another, shared out among pixels by the length within each.

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
    """From when to when, between begin and end, a segment is in the pixels of each offset along one axis; by halves of infinity if it
    stays."""
    one, other = (offset - 0.5) / length[:, None], (offset + 0.5) / length[:, None]
    return torch.minimum(one, other).clamp(min=begin), torch.maximum(one, other).clamp(max=end)


def pupil_kernels(slopes: Slopes, tables: PupilTables, offset: Offsets) -> Kernels:
    """The pupil's picture in strips, shared out among pixels by area; a very small one is a point.

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
    """The share of each stretch, relative to the centre of a pixel, that lies on the pixel of each offset."""
    start = torch.maximum(low[..., None], offset - 0.5)
    end = torch.minimum(high[..., None], offset + 0.5)
    return (end - start).clamp(min=0.0) / (high - low).clamp(min=1e-12)[..., None]


def _rest_reach(sigma_x_px: float) -> int:
    variance = sigma_x_px**2 - PIXEL_VARIANCE
    return math.ceil(3.0 * math.sqrt(variance)) if variance >= _LEAST_VARIANCE else 0


def rest_kernel(sigma_x_px: float, offset: Offsets) -> Float64[Tensor, "size size"] | None:
    """What the spatial filter has beyond a pixel, an even Gaussian, where that is wider than a pixel."""
    reach = _rest_reach(sigma_x_px)
    if reach == 0:
        return None
    taps = torch.exp(-0.5 * offset.double() ** 2 / (sigma_x_px**2 - PIXEL_VARIANCE)) * (offset.abs() <= reach)
    taps = taps / taps.sum()
    return taps[:, None] * taps
