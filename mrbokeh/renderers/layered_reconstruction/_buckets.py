"""Depth buckets: equal steps of the circle of confusion near the focus and equal steps of depth everywhere."""

import numpy as np
from jaxtyping import Float32, Int32

from mrbokeh.renderers.layered_reconstruction._settings import Settings

_OUTLIERS = (0.01, 0.99)
_ENOUGH = 65536  # samples for the percentiles of depth


def bucket_of(
    coc_px: Float32[np.ndarray, " samples"], depth_m: Float32[np.ndarray, " samples"], settings: Settings
) -> tuple[Int32[np.ndarray, " samples"], int]:
    """The bucket of each sample, front to back from 0, and how many there are; constant time per sample.

    Steps of the circle of confusion, clipped at near_coc_px, plus steps of depth: both grow with depth, so their sum does,
    and it has the borders of both. Depth is cut between its 1st and 99th percentile; background at infinity goes last.
    """
    near_px = np.float32(settings.near_coc_px)
    index = np.floor(np.clip(coc_px, -near_px, near_px) / np.float32(settings.coc_step_px) + np.float32(0.5))
    some_m = depth_m[:: max(1, len(depth_m) // _ENOUGH)]
    some_m = some_m[np.isfinite(some_m)]
    low_m, high_m = np.quantile(some_m, _OUTLIERS).tolist() if some_m.size else (0.0, 0.0)
    steps = settings.depth_buckets
    if high_m > low_m:
        # Infinity falls into a step of its own behind the last.
        share = (depth_m - np.float32(low_m)) * np.float32(steps / (high_m - low_m))
        index += np.clip(np.floor(share), 0, np.where(np.isinf(depth_m), steps, steps - 1))
    else:
        index += np.where(np.isinf(depth_m), np.float32(steps), np.float32(0.0))
    index -= index.min()
    return index.astype(np.int32), int(index.max()) + 1


def motion_cells(motion_px: Float32[np.ndarray, "samples 2"], settings: Settings) -> tuple[Int32[np.ndarray, " samples"], int, int]:
    """The cell of motion of each sample, how many there are along x and in all."""
    if not settings.motion or not np.isfinite(settings.motion_step_px):
        return np.zeros(len(motion_px), np.int32), 1, 1
    most = np.float32(settings.motion_step_px * 32)
    # Axis by axis: extremes of both at once take numpy ten times as long.
    x, y = (np.rint(np.clip(each, -most, most) / np.float32(settings.motion_step_px)).astype(np.int32) for each in motion_px.T)
    x, y = x - x.min(), y - y.min()
    across, down = int(x.max()) + 1, int(y.max()) + 1
    return y * np.int32(across) + x, across, across * down
