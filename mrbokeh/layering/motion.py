"""Motion blur of light before it goes through the aperture: every pixel is drawn out along its path during the shutter.

A point that moves evenly at one depth while the shutter is open draws its circle of confusion along its path: its PSF is the
aperture's kernel convolved with a segment of a line (the COMBINED model of Leimkuehler et al. 2018, Table 1). Convolving with
the segment first and with the kernel then is the same, for every renderer that spreads light: so the light of a slice is drawn
out here, and the slice, all of whose pixels have nearly one circle of confusion, is spread as ever. Motion is linear, without
change of depth; the picture's own time is the middle of the shutter. Kernels of a bank that hold motion themselves (psf_over_field)
take it from the same channels instead.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
from jaxtyping import Float32

from mrbokeh.images.layer import Layer
from mrbokeh.system.errors import InputError

MOTION = "motion_px"
"""Name of a layer's extra channels that hold motion: (H, W, 2), right and down, in pixels while the shutter is open, times alpha."""


def with_motion(layer: Layer, motion_px: Float32[np.ndarray, "height width 2"], shutter: float = 1.0) -> Layer:
    """Return the layer with motion, right and down, in pixels of what it shows; shutter: the part of that time for which it is open."""
    if motion_px.shape != (*layer.alpha.shape, 2):
        raise InputError(f"motion must have the shape {(*layer.alpha.shape, 2)} of its layer, but came with {motion_px.shape}: resize it")
    if not shutter >= 0.0:
        raise InputError(f"the shutter must be open for a part of the time of 0 or more, got {shutter}")
    if not np.isfinite(motion_px[layer.alpha > 0]).all():
        raise InputError("motion must be finite where the layer is visible: write 0 where nothing moves")
    moving = np.where(layer.alpha[..., None] > 0, motion_px, 0.0) * np.float32(shutter) * layer.alpha[..., None]
    return replace(layer, extra={**layer.extra, MOTION: moving.astype(np.float32)})


def motion_channels(extra: Mapping[str, np.ndarray]) -> slice | None:
    """Return the slice of motion among R, G, B, coverage and extra channels; None if there is none."""
    start = 4
    for name, values in extra.items():
        if name == MOTION:
            return slice(start, start + values.shape[2])
        start += values.shape[2]
    return None


def farthest_px(layers: Sequence[Layer]) -> int:
    """Return how many whole pixels light of any of the layers moves away from its place at most; 0 if nothing moves."""
    return max((motion_reach_px(motion_of(layer.extra[MOTION], layer.alpha)) for layer in layers if MOTION in layer.extra), default=0)


def moved(
    values: Float32[np.ndarray, "height width channels"], coc_px: Float32[np.ndarray, "height width"], channels: slice
) -> tuple[Float32[np.ndarray, "height width channels"], Float32[np.ndarray, "height width"]]:
    """Draw light out (`drawn_out`) along the motion that its own channels hold, times coverage."""
    return drawn_out(values, coc_px, motion_of(values[..., channels], values[..., 3]))


def motion_of(motion_px: Float32[np.ndarray, "*batch 2"], coverage: Float32[np.ndarray, "*batch"]) -> Float32[np.ndarray, "*batch 2"]:
    """Return the motion of what is seen, from motion times coverage; 0 where nothing is."""
    return np.divide(motion_px, coverage[..., None], out=np.zeros_like(motion_px), where=coverage[..., None] > 0)


def motion_reach_px(motion_px: Float32[np.ndarray, "height width 2"]) -> int:
    """Return how many whole pixels light moves away from its place at most, that is during half the shutter."""
    farthest = float(np.abs(motion_px).max(initial=0.0))
    return 0 if farthest == 0.0 else int(np.ceil(0.5 * farthest))


def drawn_out(
    values: Float32[np.ndarray, "height width channels"],
    coc_px: Float32[np.ndarray, "height width"],
    motion_px: Float32[np.ndarray, "height width 2"],
) -> tuple[Float32[np.ndarray, "height width channels"], Float32[np.ndarray, "height width"]]:
    """Draw light out from -motion / 2 to +motion / 2; return it and its mean circle of confusion at every pixel.

    values: premultiplied, coverage in channel 3 (it weights the mean); what leaves the array is lost. coc_px: signed diameters.
    All light is kept, its centre stays in place, and what does not move stays bit for bit where nothing moves onto it.
    """
    from mrbokeh.layering._pixels_numba import draw_out

    out, mean_coc_px, weight = np.zeros_like(values), np.zeros_like(coc_px), np.zeros_like(coc_px)
    draw_out(values, coc_px, motion_px, out, mean_coc_px, weight)
    np.divide(mean_coc_px, weight, out=mean_coc_px, where=weight > 0)
    return out, mean_coc_px
