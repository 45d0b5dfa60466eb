"""The similarity that most tracks agree on."""

import numpy as np
from jaxtyping import Float

from capture.merging.corner_tracks import CornerTracks
from capture.merging.plane_transforms import Transform, moved

AGREEING_PX = 1.0
_SMALLEST_SCATTER_PX = 0.05
_ROUNDS = 12

Distances = Float[np.ndarray, " tracks"]


def similarity_of_tracks(tracks: CornerTracks) -> Transform:
    """target_from_source by least squares, reweighted until the odd ones do not count. Wants at least 2 tracks."""
    weights = np.ones(len(tracks))
    for _ in range(_ROUNDS):
        similarity = _weighted_similarity(tracks, weights)
        off_px = distances_px(tracks, similarity)
        weights = robust_weights(off_px, typical_px(off_px))
    return similarity


def distances_px(tracks: CornerTracks, target_from_source: Transform) -> Distances:
    """How far each track's source lands from its target."""
    return np.hypot(*(tracks.target_px - moved(target_from_source, tracks.source_px)).T)


def typical_px(distances: Distances) -> float:
    """How far most lie off, and never nothing."""
    return max(_SMALLEST_SCATTER_PX, 1.5 * float(np.median(distances))) if len(distances) else 1.0


def robust_weights(distances: Distances, scatter_px: float) -> Distances:
    """Of Geman and McClure 1985: 1 for what agrees, towards 0 for what is many times the scatter off."""
    return 1.0 / (1.0 + (distances / scatter_px) ** 2) ** 2


def _weighted_similarity(tracks: CornerTracks, weights: Distances) -> Transform:
    """Umeyama 1991 in the plane, weighted."""
    share = (weights / weights.sum())[:, None]
    middle_target, middle_source = (share * tracks.target_px).sum(0), (share * tracks.source_px).sum(0)
    p, q = tracks.source_px - middle_source, tracks.target_px - middle_target
    spread = max(float((share * p * p).sum()), 1e-12)
    a = float((share * p * q).sum()) / spread
    b = float((share[:, 0] * (p[:, 0] * q[:, 1] - p[:, 1] * q[:, 0])).sum()) / spread
    turn = np.array([[a, -b], [b, a]])
    return np.column_stack([turn, middle_target - turn @ middle_source])
