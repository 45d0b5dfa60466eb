"""Depth buckets and cells of motion on a device: `mrbokeh.renderers.layered_reconstruction._buckets` by torch."""

import math

import torch
from jaxtyping import Float32, Int64
from torch import Tensor

from mrbokeh.renderers.layered_reconstruction._settings import Settings

_OUTLIERS = (0.01, 0.99)
_ENOUGH = 65536  # samples for the percentiles of depth
_FARTHEST_CELL = 32


def depth_buckets(
    coc_px: Float32[Tensor, " samples"], depth_m: Float32[Tensor, " samples"], settings: Settings
) -> Int64[Tensor, " samples"]:
    """The bucket of each sample, front to back from 0; see `bucket_of`."""
    near_px, steps = settings.near_coc_px, settings.depth_buckets
    index = torch.floor(coc_px.clamp(-near_px, near_px) / settings.coc_step_px + 0.5)
    some_m = depth_m[:: max(1, len(depth_m) // _ENOUGH)].double()
    some_m = torch.where(torch.isfinite(some_m), some_m, torch.nan)
    low_m, high_m = torch.nanquantile(some_m, torch.tensor(_OUTLIERS, dtype=torch.float64, device=some_m.device))
    is_far = torch.isinf(depth_m)
    share = (depth_m - low_m.float()) * (steps / (high_m - low_m)).float()
    # Infinity falls into a step of its own behind the last.
    cut = torch.minimum(torch.floor(share).clamp(min=0), torch.where(is_far, steps, steps - 1))
    index += torch.where(high_m > low_m, cut, torch.where(is_far, float(steps), 0.0))
    return (index - index.min()).long()


def motion_cells(motion_px: Float32[Tensor, "samples 2"], settings: Settings) -> Int64[Tensor, "samples 2"]:
    """Column and row of the cell of motion of each sample, from 0."""
    if not settings.motion or not math.isfinite(settings.motion_step_px):
        return torch.zeros_like(motion_px, dtype=torch.int64)
    most_px = settings.motion_step_px * _FARTHEST_CELL
    cells = torch.round(motion_px.clamp(-most_px, most_px) / settings.motion_step_px).long()
    return cells - cells.amin(dim=0)
