"""Samples as the kernels want them: sorted by tile, centred, with their slopes, depth buckets and the window they fill."""

import numpy as np
from jaxtyping import Float32, Float64

from mrbokeh.layering.light_field_samples import LightFieldSamples
from mrbokeh.renderers.layered_reconstruction._buckets import bucket_of, motion_cells
from mrbokeh.renderers.layered_reconstruction._settings import Settings
from mrbokeh.renderers.layered_reconstruction._tile_data import BLOCKS, Light


def prepared(
    samples: LightFieldSamples,
    values: Float32[np.ndarray, "samples channels"],
    coc_px: Float32[np.ndarray, " samples"],
    settings: Settings,
) -> Light:
    """values: (N, C) what is reconstructed, the samples' rgb or more. coc_px: their circles of confusion."""
    from mrbokeh.renderers.layered_reconstruction._samples_numba import gather, tile_order

    columns, rows = -(-samples.width_px // settings.tile_px), -(-samples.height_px // settings.tile_px)
    order, starts = np.empty(samples.count, np.int64), np.empty(columns * rows * BLOCKS + 1, np.int64)
    tile_order(samples.xy_px, samples.width_px, samples.height_px, settings.tile_px, order, starts)
    bucket, buckets = bucket_of(coc_px, samples.depth_m, settings)
    cell, across, cells = motion_cells(samples.motion_px, settings)
    bucket = bucket * np.int32(cells) + cell
    geometry, slopes = np.empty((samples.count, 5), np.float32), np.empty((samples.count, 3), np.float32)
    sorted_values, sorted_bucket = np.empty(values.shape, np.float32), np.empty(samples.count, np.int32)
    rays = samples.xy_px, samples.lens_uv, samples.time, coc_px, samples.motion_px
    gather(order, *rays, values, bucket, settings.motion, geometry, slopes, sorted_values, sorted_bucket)
    reach = float(np.abs(samples.lens_uv).max())
    return Light(
        geometry, slopes, sorted_values, sorted_bucket, starts, columns, settings.tile_px, across, cells, buckets, _window(samples), reach,
        samples.per_pixel,
    )  # fmt: skip


def _window(samples: LightFieldSamples) -> Float64[np.ndarray, "4"]:
    """Of an even disc the second moment is 1/4 along each axis, of an even shutter 1/12."""
    u, v = samples.lens_uv.T
    t = samples.time - np.float32(0.5)
    return np.array([np.mean(a * b, dtype=np.float64) for a, b in ((u, u), (u, v), (v, v), (t, t))])
