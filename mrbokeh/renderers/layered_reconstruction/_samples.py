"""Light field samples for layered reconstruction: taken of layers along rays, and sorted by tile as the compiled loops want them.

Sorted samples are centred and have slopes, depth buckets and cells of motion. Depth buckets are equal steps of the circle of confusion
near the focus and equal steps of depth everywhere.
"""

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from os import cpu_count

import numpy as np
from jaxtyping import Float32, Float64, Int32

from mrbokeh.images.layer import Layer
from mrbokeh.layering.light_field_samples import LightFieldSamples
from mrbokeh.layering.motion import MOTION
from mrbokeh.layering.padded_layers import check_reach
from mrbokeh.layering.psf_over_field import reach_px
from mrbokeh.optics.drawn_diameters import drawn_diameters_px
from mrbokeh.optics.lens import Lens
from mrbokeh.renderers.layered_reconstruction._settings import Settings
from mrbokeh.renderers.layered_reconstruction._tile_data import BLOCKS, STRIPS, Light, pupil_spans
from mrbokeh.system.errors import InputError

_BAND_ROWS = 16


def motion_of(layer: Layer) -> Float32[np.ndarray, "height width 2"]:
    """Return motion in pixels, not premultiplied; 0 if the layer has none."""
    if MOTION not in layer.extra:
        return np.zeros((*layer.alpha.shape, 2), np.float32)
    if layer.extra[MOTION].shape[2] != 2:
        raise InputError(
            f"the extra channel {MOTION!r} is motion in x and y and needs the shape (H, W, 2), got {layer.extra[MOTION].shape}"
        )
    return layer.extra[MOTION] / np.maximum(layer.alpha, 1e-6)[..., None]


def coc_px_of(layer: Layer, lens: Lens) -> Float32[np.ndarray, "height width"]:
    """Return signed diameters to draw (optics.drawn_diameters); 0 where nothing is covered and up to one pixel, where light stays as
    it is.
    """
    covered = layer.alpha > 0
    if not (layer.depth_m > 0)[covered].all():
        raise InputError("every visible pixel needs a finite circle of confusion: depth must be positive (or inf), not 0 or NaN")
    coc_px = drawn_diameters_px(
        np.asarray(lens.coc_px(np.where(covered, layer.depth_m, np.inf), layer.width_px), np.float32), lens.aperture
    )
    return np.where(covered & (np.abs(coc_px) > 1.0), coc_px, 0.0).astype(np.float32)


def all_sharp(layers: Sequence[Layer], lens: Lens) -> bool:
    """Return whether nothing moves and every circle of confusion is at most one pixel: then there is nothing to take samples of."""
    return not any(coc_px_of(layer, lens).any() or motion_of(layer).any() for layer in layers)


def sample_layers(
    layers: Sequence[Layer], lens: Lens, per_pixel: int, seed: int, threads: int
) -> tuple[LightFieldSamples, Float32[np.ndarray, "samples channels"], Float32[np.ndarray, " samples"], int]:
    """Return samples of the layers continued beyond the frame, their values (N, 4 + E: R, G, B, coverage, others), their circles of
    confusion, and the margin in pixels.

    Opaque layers go on beyond the frame as their border pixels do, others do not. A ray that meets nothing is a black sample
    of coverage 0 at infinity.
    """
    coc_px, motions = [coc_px_of(layer, lens) for layer in layers], [motion_of(layer) for layer in layers]
    blur_px = reach_px(lens.aperture, max(float(np.abs(each).max()) for each in coc_px))
    margin = blur_px + int(np.ceil(0.5 * max(float(np.abs(motion).max()) for motion in motions)))
    check_reach(layers, coc_px, margin)
    stacks = [
        np.concatenate(
            [layer.rgb, layer.alpha[..., None], *layer.extra.values(), each[..., None], layer.depth_m[..., None], motion], axis=2
        )
        for layer, each, motion in zip(layers, coc_px, motions, strict=True)
    ]
    continued = np.stack([_continued(stack, margin, bool((stack[..., 3] == 1.0).all())) for stack in stacks])
    rays = _Rays(continued=continued, lens=lens, per_pixel=per_pixel, seed=seed, threads=threads)
    hit = rays.met[:, 0] >= 0
    met = np.zeros((len(hit), continued.shape[3]), np.float32)
    met[:, -4], met[:, -3] = lens.coc_px(np.inf, layers[0].width_px), np.inf
    met[hit] = continued[tuple(rays.met[hit].T)]
    values = met[:, :-4] / np.where(hit, met[:, 3], 1.0)[:, None]
    # A ray of an opaque scene that still met nothing left the continued picture; it says nothing.
    keep = hit if rays.is_opaque else np.ones_like(hit)
    size_px = continued.shape[2], continued.shape[1]
    arrays = rays.xy_px, rays.lens_uv, rays.time, values[:, :3], met[:, -3], met[:, -2:]
    samples = LightFieldSamples(*size_px, *(np.ascontiguousarray(each[keep]) for each in arrays))
    return samples, values[keep], met[keep, -4], margin


def _continued(planes: Float32[np.ndarray, "height width channels"], margin: int, is_opaque: bool) -> Float32[np.ndarray, "h w channels"]:
    around = ((margin, margin), (margin, margin), (0, 0))
    return np.pad(planes, around, mode="edge") if is_opaque else np.pad(planes, around)


class _Rays:
    """Rays of all samples: xy_px, lens_uv, time, and met (N, 3): layer, row and column, or -1."""

    def __init__(
        self, continued: Float32[np.ndarray, "layers height width _"], lens: Lens, per_pixel: int, seed: int, threads: int
    ) -> None:
        from mrbokeh.renderers.layered_reconstruction._layer_rays_numba import Pupil, Samples, Surfaces, trace_rows

        height, width = continued.shape[1:3]
        count = height * width * per_pixel
        self.xy_px, self.lens_uv = np.empty((count, 2), np.float32), np.empty((count, 2), np.float32)
        self.time, self.met = np.empty(count, np.float32), np.empty((count, 3), np.int32)
        radius_px, alpha = np.ascontiguousarray(0.5 * continued[..., -4]), np.ascontiguousarray(continued[..., 3])
        ranges = np.array([_range(r[a > 0]) for r, a in zip(radius_px, alpha, strict=True)])
        self.is_opaque = bool((alpha == 1.0).all(axis=(1, 2)).any())
        motion_px = np.ascontiguousarray(continued[..., -2:])
        surfaces = Surfaces(
            radius_px=radius_px,
            alpha=alpha,
            motion_px=motion_px,
            fastest_px=np.stack([_fastest_around(each) for each in motion_px]),
            ranges_px=ranges,
            is_opaque=self.is_opaque,
        )
        pupil, results = Pupil(*_pupil(lens)), Samples(self.xy_px, self.lens_uv, self.time, self.met)

        def run(top: int) -> None:
            trace_rows(top, min(top + _BAND_ROWS, height), width, per_pixel, seed, pupil, surfaces, results)

        with ThreadPoolExecutor(threads or cpu_count() or 1) as pool:
            list(pool.map(run, range(0, height, _BAND_ROWS)))


def _fastest_around(motion_px: Float32[np.ndarray, "height width 2"]) -> Float32[np.ndarray, "height width 2"]:
    """Return for each pixel the fastest of all motions that begin within its reach."""
    from scipy.ndimage import maximum_filter

    reach = int(np.ceil(0.5 * np.abs(motion_px).max()))
    if reach == 0:
        return motion_px
    speeds = np.hypot(*motion_px.reshape(-1, 2).T)
    order = np.argsort(speeds, kind="stable")
    rank = np.empty(len(order), np.int32)
    rank[order] = np.arange(len(order))
    return motion_px.reshape(-1, 2)[order[maximum_filter(rank.reshape(motion_px.shape[:2]), 2 * reach + 1)]]


def _range(radii_px: np.ndarray) -> tuple[float, float]:
    return (float(radii_px.min()), float(radii_px.max())) if radii_px.size else (0.0, 0.0)


def _pupil(lens: Lens) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Return strips in front of the focus and behind it, running sums of their weights, where each side begins, heights of the strips."""
    sides = [lens.aperture.seen(side) for side in (-1, 1)]
    tables = [pupil_spans(aperture, STRIPS[-1]) for aperture in sides]
    corners = [np.concatenate(aperture.outlines)[:, 1] for aperture in sides]
    heights = np.array([(v.max() - v.min()) / STRIPS[-1] for v in corners])
    running = np.concatenate([np.cumsum(table[:, 3]) for table in tables])
    return np.concatenate(tables), running, np.cumsum([0, *(len(table) for table in tables)]), heights


_OUTLIERS = (0.01, 0.99)
_ENOUGH = 65536  # samples for the percentiles of depth


def bucket_of(
    coc_px: Float32[np.ndarray, " samples"], depth_m: Float32[np.ndarray, " samples"], settings: Settings
) -> tuple[Int32[np.ndarray, " samples"], int]:
    """Return the bucket of each sample, front to back from 0, and how many there are; constant time per sample.

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
    """Return the cell of motion of each sample, how many there are along x and in all."""
    if not settings.motion or not np.isfinite(settings.motion_step_px):
        return np.zeros(len(motion_px), np.int32), 1, 1
    most = np.float32(settings.motion_step_px * 32)
    # Axis by axis: extremes of both at once take numpy ten times as long.
    x, y = (np.rint(np.clip(each, -most, most) / np.float32(settings.motion_step_px)).astype(np.int32) for each in motion_px.T)
    x, y = x - x.min(), y - y.min()
    across, down = int(x.max()) + 1, int(y.max()) + 1
    return y * np.int32(across) + x, across, across * down


def prepared(
    samples: LightFieldSamples,
    values: Float32[np.ndarray, "samples channels"],
    coc_px: Float32[np.ndarray, " samples"],
    settings: Settings,
) -> Light:
    """Sort samples by tile. values: (N, C) what is reconstructed, the samples' rgb or more. coc_px: their
    circles of confusion.
    """
    from mrbokeh.renderers.layered_reconstruction._filter_numba import tile_order

    columns, rows = -(-samples.width_px // settings.tile_px), -(-samples.height_px // settings.tile_px)
    order, starts = np.empty(samples.count, np.int64), np.empty(columns * rows * BLOCKS + 1, np.int64)
    tile_order(samples.xy_px, samples.width_px, samples.height_px, settings.tile_px, order, starts)
    bucket, buckets = bucket_of(coc_px, samples.depth_m, settings)
    cell, across, cells = motion_cells(samples.motion_px, settings)
    bucket = bucket * np.int32(cells) + cell
    geometry = np.concatenate([samples.xy_px, samples.lens_uv, (samples.time - np.float32(0.5))[:, None]], axis=1)
    motion_px = samples.motion_px if settings.motion else np.zeros_like(samples.motion_px)
    slopes = np.concatenate([np.float32(0.5) * coc_px[:, None], motion_px], axis=1)
    reach = float(np.abs(samples.lens_uv).max())
    return Light(
        geometry=geometry[order],
        slopes=slopes[order],
        values=values[order],
        bucket=bucket[order],
        starts=starts,
        columns=columns,
        tile_px=settings.tile_px,
        cells_x=across,
        cells=cells,
        depths=buckets,
        window=_window(samples),
        pupil_radius=reach,
        per_pixel=samples.per_pixel,
    )


def _window(samples: LightFieldSamples) -> Float64[np.ndarray, "4"]:
    """Return the second moments of pupil and shutter: 1/4 along each axis for an even disc, 1/12 for an even shutter."""
    u, v = samples.lens_uv.T
    t = samples.time - np.float32(0.5)
    return np.array([np.mean(a * b, dtype=np.float64) for a, b in ((u, u), (u, v), (v, v), (t, t))])
