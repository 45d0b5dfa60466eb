"""Reconstruction from light field samples: each sample's PSF is put around the point that it saw (Leimkuehler et al. 2018, Section 6.2).

A sample at y is one ray of a point whose light is spread all over its circle of confusion and its path. Splatting the PSF at y
would apply it twice; around y' = y - coc/2 uv - motion (t - 1/2) it is put where it belongs (Fig. 7). Samples are taken in
slices of the circle of confusion, front first: each takes what is still free of a pixel, at most its coverage, that is its
weight over the samples per pixel; what remains open in the end is shared out.
"""

from collections.abc import Iterator
from typing import Protocol, runtime_checkable

import numpy as np
from jaxtyping import Bool, Float32

from mrbokeh.images.layer import Layer
from mrbokeh.layering.layering import Layering
from mrbokeh.layering.light_field_samples import LightFieldSamples
from mrbokeh.layering.motion import drawn_out
from mrbokeh.layering.psf_over_field import Frame, blur_colours
from mrbokeh.optics.aperture import Aperture
from mrbokeh.optics.lens import Lens
from mrbokeh.renderers.bank.tables import Place

_LEAST_STEP_PX, _NOTHING_TAKEN = 0.5, 1e-6

Plane = Float32[np.ndarray, "height width"]
Channels = Float32[np.ndarray, "height width channels"]


@runtime_checkable
class _Renderer(Protocol):
    @property
    def layering(self) -> Layering: ...
    @property
    def bank(self) -> object: ...
    def sum_kernels(self, values: Channels, coc_px: Plane, aperture: Aperture) -> Channels: ...
    def sum_bank_kernels(self, values: Channels, coc_px: Plane, place: Place) -> Channels: ...


def reconstructed(samples: LightFieldSamples, lens: Lens, renderer: _Renderer) -> Layer:
    """Return an opaque picture; its depth is that of the nearest sample in each pixel."""
    coc_px, at_px = samples.coc_px(lens), samples.positions_at_lens_centre_px(lens)
    step_px = max(float(np.ptp(coc_px)) / renderer.layering.slices, _LEAST_STEP_PX)
    index = np.floor(coc_px / step_px + 0.5).astype(np.int64)
    margin = int(np.ceil(max(0.0, -at_px.min(), (at_px - (samples.width_px, samples.height_px)).max()))) + 1
    margin += int(np.ceil(0.5 * np.abs(samples.motion_px).max()))
    size = samples.height_px, samples.width_px
    colour, taken = np.zeros((*size, 3), np.float32), np.zeros((*size, 1), np.float32)
    inside = np.s_[margin : margin + samples.height_px, margin : margin + samples.width_px]
    for each in np.unique(index):
        rounds = _rounds(samples, coc_px, at_px, index == each, margin)
        light = np.sum([_blur_round(*piece, samples, lens, renderer, margin)[inside] for piece in rounds], axis=0)
        weight = np.maximum(light[..., 3:], 0.0)  # one for all colours, or one for each
        share = np.minimum(weight / np.float32(samples.per_pixel), 1.0 - taken)
        colour += share * light[..., :3] / np.maximum(weight, _NOTHING_TAKEN)
        taken = taken + share
    rgb = np.maximum(colour / np.maximum(taken, _NOTHING_TAKEN), 0.0).astype(np.float32)
    return Layer(rgb, np.ones(size, np.float32), _nearest_m(samples))


def _rounds(
    samples: LightFieldSamples, coc_px: Float32[np.ndarray, " samples"], at_px: np.ndarray, mine: Bool[np.ndarray, " samples"], margin: int
) -> Iterator[tuple[Channels, Plane, np.ndarray]]:
    """Yield R, G, B and weight, circles of confusion and motion of the first sample of every pixel, then the second, and so on."""
    chosen = np.flatnonzero(mine)
    x, y = np.floor(at_px[chosen]).astype(np.int64).T + margin
    size = samples.height_px + 2 * margin, samples.width_px + 2 * margin
    place = y * size[1] + x
    order = np.argsort(place, kind="stable")
    place, chosen = place[order], chosen[order]
    nth = np.arange(len(place)) - np.searchsorted(place, place)
    for k in range(int(nth.max()) + 1):
        where, who = np.unravel_index(place[nth == k], size), chosen[nth == k]
        values, circles, motion = np.zeros((*size, 4), np.float32), np.zeros(size, np.float32), np.zeros((*size, 2), np.float32)
        values[where] = np.concatenate([samples.rgb[who], np.ones((len(who), 1), np.float32)], axis=1)
        circles[where], motion[where] = coc_px[who], samples.motion_px[who]
        yield values, circles, motion


def _blur_round(
    values: Channels, coc_px: Plane, motion_px: np.ndarray, samples: LightFieldSamples, lens: Lens, renderer: _Renderer, margin: int
) -> np.ndarray:
    """Blur light by the aperture, drawn out along its path before, or by the kernels of the bank."""
    if renderer.bank is None:
        moving, circles = drawn_out(values, coc_px, motion_px) if motion_px.any() else (values, coc_px)
        frame = Frame(samples.width_px, samples.height_px, -margin, -margin)
        return blur_colours(renderer.sum_kernels, moving, circles, lens.aperture, frame, renderer.layering.field_cells)
    half_diagonal_px = 0.5 * np.hypot(samples.width_px, samples.height_px)
    rows, columns = np.indices(coc_px.shape) + 0.5 - margin
    field_xy = np.stack([columns - 0.5 * samples.width_px, rows - 0.5 * samples.height_px], axis=2) / half_diagonal_px
    dioptres = 1.0 / lens.focus_distance_m - coc_px / lens.coc_px_per_dioptre(samples.width_px)
    with np.errstate(divide="ignore"):
        depth_m = np.where(dioptres > 0.0, 1.0 / dioptres, np.inf)
    return renderer.sum_bank_kernels(values, coc_px, Place(motion_px, field_xy, depth_m))


def _nearest_m(samples: LightFieldSamples) -> Plane:
    x, y = samples.pixels()
    depth_m = np.full((samples.height_px, samples.width_px), np.inf, np.float32)
    np.minimum.at(depth_m, (y, x), samples.depth_m)
    return depth_m
