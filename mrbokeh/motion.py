"""Motion blur of light before it goes through the aperture: every pixel is drawn out along its path during the shutter.

A point that moves evenly at one depth while the shutter is open draws its circle of confusion along its path: its PSF is the
aperture's kernel convolved with a segment of a line (the COMBINED model of Leimkuehler et al. 2018, Table 1). Convolving with
the segment first and with the kernel then is the same, for every renderer that spreads light: so the light of a slice is drawn
out here, and the slice, all of whose pixels have nearly one circle of confusion, is spread as ever. Motion is linear, without
change of depth; the picture's own time is the middle of the shutter.
"""

import numpy as np
from jaxtyping import Float32

MOTION = "motion_px"
"""Name of a layer's extra channels that hold motion: (H, W, 2), right and down, in pixels while the shutter is open, times alpha."""


def motion_reach_px(motion_px: Float32[np.ndarray, "height width 2"]) -> int:
    """How many whole pixels light may move away from its place at most, that is during half the shutter."""
    farthest = float(np.abs(motion_px).max(initial=0.0))
    return 0 if farthest == 0.0 else int(np.ceil(0.5 * farthest))


def drawn_out(
    values: Float32[np.ndarray, "height width channels"],
    coc_px: Float32[np.ndarray, "height width"],
    motion_px: Float32[np.ndarray, "height width 2"],
) -> tuple[Float32[np.ndarray, "height width channels"], Float32[np.ndarray, "height width"]]:
    """The light on its way from -motion / 2 to +motion / 2, and its mean circle of confusion at every pixel.

    values: premultiplied, coverage in channel 3 (it weights the mean); what leaves the array is lost. coc_px: signed diameters.
    All light is kept, its centre stays in place, and what does not move stays bit for bit where nothing moves onto it.
    """
    from mrbokeh._motion_numba import draw_out

    out, mean_coc_px, weight = np.zeros_like(values), np.zeros_like(coc_px), np.zeros_like(coc_px)
    draw_out(values, coc_px, motion_px, out, mean_coc_px, weight)
    np.divide(mean_coc_px, weight, out=mean_coc_px, where=weight > 0)
    return out, mean_coc_px
