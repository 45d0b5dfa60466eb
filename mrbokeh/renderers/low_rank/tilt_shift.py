"""Tilt-shift: a photograph blurred by a map that somebody drew, without any depth (McGraw, Section 4 and Fig. 14).

A tilted lens keeps a wedge of space sharp; a gradient of blur drawn over a photograph looks alike and makes the subject
seem small. The map is one of diameters in pixels: 0 along the band to keep, growing smoothly away from it.
"""

import numpy as np
from jaxtyping import Float32

from mrbokeh.optics.aperture import Aperture
from mrbokeh.optics.psf import kernel_radius_px
from mrbokeh.renderers.low_rank.low_rank_filter import LowRankFilter
from mrbokeh.system.errors import InputError

_LEAST_COVERAGE = 1e-6


def tilt_shift(
    rgb: Float32[np.ndarray, "height width 3"],
    coc_px: Float32[np.ndarray, "rows columns"],
    aperture: Aperture,
    rank: int = 3,
    threads: int = 0,
) -> Float32[np.ndarray, "height width 3"]:
    """A scene-linear picture with every pixel spread by its own diameter, and the sum divided by how much arrived.

    coc_px: from 0 (kept; anything below 1 px is) to any size; negative diameters mirror the aperture. Steps in the map are
    allowed and give what no depth can order: light of both sides mixes across them. aperture: plain.
    rank: terms per kernel, 3 as in the paper; kernels up to 9 px take as many as they need. threads: 0 takes all cores.
    The picture is continued beyond its border by its mirror image; an even picture stays even.
    """
    if rgb.ndim != 3 or rgb.shape[2] != 3 or rgb.shape[:2] != coc_px.shape:
        raise InputError(f"tilt-shift needs a picture (H, W, 3) and a map of diameters (H, W), got {rgb.shape} and {coc_px.shape}")
    if not np.isfinite(rgb).all() or not np.isfinite(coc_px).all():
        raise InputError("tilt-shift needs finite colours and diameters, but some are inf or NaN: draw a diameter for every pixel")
    if not aperture.is_plain:
        raise InputError("tilt-shift needs a plain aperture, but this one has modifiers: give it as it is seen, aperture.seen(...)")
    margin = kernel_radius_px(float(np.abs(coc_px).max()), aperture.unit_radius)
    around = ((margin, margin), (margin, margin))
    values = np.dstack([rgb, np.ones_like(coc_px)])
    wide = np.pad(values, (*around, (0, 0)), mode="symmetric"), np.pad(coc_px, around, mode="symmetric")
    spread = LowRankFilter(relative_error=0.0, max_rank=rank, threads=threads).spread(*wide, aperture)
    inside = spread[margin : margin + coc_px.shape[0], margin : margin + coc_px.shape[1]]
    return inside[..., :3] / np.maximum(inside[..., 3:], np.float32(_LEAST_COVERAGE))
