"""The first guess of how two neighbouring slices lie: masked ECC on small pictures, from coarse to less coarse."""

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Float32, UInt8

from capture.merging.plane_transforms import Transform, as_similarity, at_level, from_opencv_centres, inverse, scale_of, to_opencv_centres
from capture.merging.slice_structure import SliceStructure, shrunk, shrunk_mask

LEAST_CORRELATION = 0.6
# Far more than any lens breathes between neighbouring slices of a stack.
LARGEST_STEP = 0.15
_COARSEST_PX = 80
_SIGMA_PX = 1.5
_STOP = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 60, 1e-4)
_OPENCV_SMOOTHING_PX = 5

Plane = Float32[np.ndarray, "height width"]
Mask = UInt8[np.ndarray, "height width"]


@dataclass(frozen=True)
class CoarseMatch:
    """correlation: of the smoothed log luminance, 1 is perfect, 0 where ECC found nothing."""

    target_from_source: Transform
    correlation: float

    @property
    def holds(self) -> bool:
        return self.correlation >= LEAST_CORRELATION


def match_coarsely(target: SliceStructure, source: SliceStructure, start: Transform) -> CoarseMatch:
    """Coarse-to-fine ECC (Evangelidis and Psarakis 2008) over what is usable in both, projected to a similarity.

    A level that does not correlate, or whose scale leaves start by more than LARGEST_STEP, moves nothing; the correlation
    is that of the finest level.
    """
    transform, correlation = start, 0.0
    for level in range(max(0, int(np.log2(max(1.0, min(target.coarse.shape) / _COARSEST_PX)))), -1, -1):
        found, correlation = _match_at(level, target, source, transform)
        if abs(scale_of(found) / scale_of(start) - 1.0) > LARGEST_STEP:
            correlation = 0.0
        if correlation >= LEAST_CORRELATION:
            transform = found
    return CoarseMatch(transform, correlation)


def _match_at(level: int, target: SliceStructure, source: SliceStructure, guess: Transform) -> tuple[Transform, float]:
    in_all = target.levels[0].level + level
    # Smoothed so that two slices differ less by their focus.
    one, other = (cv2.GaussianBlur(shrunk(each.coarse, level), (0, 0), _SIGMA_PX) for each in (target, source))
    mask, other_mask = (shrunk_mask(each.coarse_usable, level) for each in (target, source))
    start = to_opencv_centres(inverse(at_level(guess, in_all))).astype(np.float32)
    try:
        correlation, found = cv2.findTransformECCWithMask(
            one, other, mask, other_mask, start, cv2.MOTION_AFFINE, _STOP, _OPENCV_SMOOTHING_PX
        )
        # OpenCV wants, and returns, source_from_target.
        affine = inverse(from_opencv_centres(np.asarray(found, np.float64)))
    except (cv2.error, np.linalg.LinAlgError):  # it did not converge
        return guess, 0.0
    if not (np.isfinite(correlation) and np.isfinite(affine).all()):  # nothing to compare: flat, or all masked
        return guess, 0.0
    return at_level(as_similarity(affine, one.shape[1], one.shape[0]), -in_all), float(correlation)
