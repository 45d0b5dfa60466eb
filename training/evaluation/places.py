"""Where in a slice the telling pixels lie: near depth edges, on their sharp side, in the discs of lights."""

import numpy as np
from jaxtyping import Bool

from mrbokeh.images.image_metrics import depth_edge_mask
from mrbokeh.optics.aperture import Aperture
from training.evaluation.unseen_slice import UnseenSlice

EDGE_STEP_PX = 2.0
"""An edge is where the circle of confusion of neighbouring pixels differs by more."""
SHARP_PX = 2.0
"""What has a smaller circle of confusion is sharp."""
WHITE = 1.0
LEAST_DISC_PX = 3.0
LEAST_LIGHT = 0.05
"""A disc ends where it brings less radiance."""

Mask = Bool[np.ndarray, "height width"]


def edge_band(seen: UnseenSlice) -> Mask:
    """Pixels that count within half of the largest circle of confusion of a depth edge, as far as its blur can reach."""
    reach_px = max(1, int(np.ceil(np.abs(seen.pair.coc_px[seen.counted]).max(initial=0.0) / 2.0)))
    step_dioptres = EDGE_STEP_PX / seen.lens.coc_px_per_dioptre(seen.depth_m.shape[1])
    return depth_edge_mask(seen.depth_m, reach_px, step_dioptres) & seen.counted


def sharp_side(seen: UnseenSlice) -> Mask:
    """The part of the band that is in focus, over which the light of the other side may run."""
    return edge_band(seen) & (np.abs(seen.pair.coc_px) <= SHARP_PX)


def light_discs(seen: UnseenSlice) -> Mask:
    """Pixels that count and that light above white reaches from pixels blurred by at least LEAST_DISC_PX."""
    from mrbokeh.renderers.scatter.scatter_reference import scatter

    excess = np.maximum(seen.pair.all_in_focus.max(axis=2) - WHITE, 0.0).astype(np.float64)
    excess[np.abs(seen.pair.coc_px) < LEAST_DISC_PX] = 0.0
    if not excess.any():
        return np.zeros_like(seen.counted)
    light = scatter(excess[..., None], seen.pair.coc_px, Aperture.disc())[..., 0]
    return (light >= LEAST_LIGHT) & seen.counted
