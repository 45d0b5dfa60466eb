"""Registration of a focal stack: undoes focus breathing and small movements by one similarity per slice."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Float, Float32

COARSEST_PX = 96
LEAST_CORRELATION = 0.6
# How far the scale between neighbours may be from what the lens predicts, or from 1 where the lens is unknown.
LARGEST_STEP_FROM_PRIOR = 0.02
LARGEST_STEP = 0.15
# Blur that differs at depth edges moves ECC by about this much between neighbours; less is no movement of the camera.
LEAST_MOVEMENT_PX = 0.25

Rgb = Float32[np.ndarray, "height width 3"]
Plane = Float32[np.ndarray, "height width"]
Similarity = Float[np.ndarray, "2 3"]


@dataclass(frozen=True)
class Registration:
    """How the slices of a stack fit together.

    reference: index of the slice with the narrowest field of view; all others are enlarged to match it.
    reference_from_slice: (2, 3) per slice, pixel coordinates with (0.5, 0.5) at the centre of the first pixel.
    correlations: ECC correlation of each neighbour pair (1 is perfect).
    """

    reference: int
    reference_from_slice: tuple[Similarity, ...]
    correlations: tuple[float, ...]

    @property
    def scales(self) -> tuple[float, ...]:
        return tuple(scale_of(transform) for transform in self.reference_from_slice)


def register_stack(read_rgb: Callable[[int], Rgb], count: int, prior_scales: Sequence[float] | None = None) -> Registration:
    """Chain neighbouring slices by coarse-to-fine ECC (Evangelidis and Psarakis 2008) projected to similarities.

    read_rgb: gives slice i; only two are held at a time.
    prior_scales: expected magnification of each slice (image distances of the thin lens), where the lens is known.
    A pair that does not correlate keeps the prior.
    """
    first_from_slice, correlations = [np.eye(2, 3)], []
    previous = structure(read_rgb(0))
    for index in range(1, count):
        current = structure(read_rgb(index))
        expected = None if prior_scales is None else prior_scales[index - 1] / prior_scales[index]
        step, correlation = register_pair(previous, current, expected)
        first_from_slice.append(chained(first_from_slice[-1], step))
        correlations.append(correlation)
        previous = current
    reference = int(np.argmin([scale_of(transform) for transform in first_from_slice]))
    reference_from_first = inverse(first_from_slice[reference])
    transforms = tuple(chained(reference_from_first, transform) for transform in first_from_slice)
    return Registration(reference, transforms, tuple(correlations))


def structure(rgb: Rgb) -> Plane:
    """What ECC compares: log luminance, in which bright lights do not outshout the rest."""
    luminance = rgb @ np.array([0.2126, 0.7152, 0.0722], np.float32)
    return np.log(np.maximum(luminance, 0.0) + np.float32(0.02)).astype(np.float32)


def register_pair(target: Plane, source: Plane, expected_scale: float | None = None) -> tuple[Similarity, float]:
    """(target_from_source, correlation). Falls back to the expected scale about the centre where ECC does not hold.

    A known lens on a tripod needs nothing but the expected scale: what ECC finds beyond it counts from LEAST_MOVEMENT_PX on.
    """
    height, width = target.shape
    start_scale, largest_step = (1.0, LARGEST_STEP) if expected_scale is None else (expected_scale, LARGEST_STEP_FROM_PRIOR)
    transform = about_centre(start_scale, width, height)
    correlation = 0.0
    for level in _pyramid_levels(min(height, width)):
        refined, correlation = _ecc(_shrunk(target, level), _shrunk(source, level), _at_level(transform, level))
        if correlation < LEAST_CORRELATION:
            continue
        candidate = _at_level(as_similarity(refined), -level)
        if abs(scale_of(candidate) / start_scale - 1.0) <= largest_step:
            transform = candidate
    predicted = about_centre(start_scale, width, height)
    if expected_scale is not None and farthest_corner_px(transform, predicted, width, height) < LEAST_MOVEMENT_PX:
        return predicted, correlation
    return transform, correlation


def warp(rgb: Rgb, reference_from_slice: Similarity) -> Rgb:
    """Resample with a cubic kernel that cannot overshoot: beside a bright light the lobes would leave dark holes.

    Where the slice has no data the border pixel goes on.
    """
    if np.allclose(reference_from_slice, np.eye(2, 3), atol=1e-9):
        return rgb
    matrix = _opencv_centres(reference_from_slice)
    size = (rgb.shape[1], rgb.shape[0])
    box = np.ones((3, 3), np.uint8)

    def sampled(image: Rgb, method: int) -> Rgb:
        return cv2.warpAffine(image, matrix, size, flags=method, borderMode=cv2.BORDER_REPLICATE)

    lowest, highest = sampled(cv2.erode(rgb, box), cv2.INTER_NEAREST), sampled(cv2.dilate(rgb, box), cv2.INTER_NEAREST)
    return np.clip(sampled(rgb, cv2.INTER_CUBIC), lowest, highest)


def scale_of(similarity: Similarity) -> float:
    return float(np.hypot(similarity[0, 0], similarity[1, 0]))


def farthest_corner_px(a: Similarity, b: Similarity, width_px: int, height_px: int) -> float:
    """How far apart two transforms take a corner of the picture."""
    corners = np.array([[x, y, 1.0] for x in (0, width_px) for y in (0, height_px)])
    return float(np.hypot(*((a - b) @ corners.T)).max())


def about_centre(scale: float, width_px: int, height_px: int) -> Similarity:
    """Scaling about the centre of the picture."""
    return np.array([[scale, 0.0, (1 - scale) * width_px / 2], [0.0, scale, (1 - scale) * height_px / 2]])


def chained(outer: Similarity, inner: Similarity) -> Similarity:
    """First `inner`, then `outer`."""
    return (np.vstack([outer, [0, 0, 1]]) @ np.vstack([inner, [0, 0, 1]]))[:2]


def inverse(similarity: Similarity) -> Similarity:
    return np.linalg.inv(np.vstack([similarity, [0, 0, 1]]))[:2]


def as_similarity(affine: Similarity) -> Similarity:
    """The scale, rotation and translation nearest to an affine transform."""
    a, b = 0.5 * (affine[0, 0] + affine[1, 1]), 0.5 * (affine[1, 0] - affine[0, 1])
    return np.array([[a, -b, affine[0, 2]], [b, a, affine[1, 2]]])


def _pyramid_levels(smaller_side_px: int) -> range:
    coarsest = max(0, int(np.floor(np.log2(smaller_side_px / COARSEST_PX))))
    return range(coarsest, -1, -1)


def _shrunk(plane: Plane, level: int) -> Float32[np.ndarray, "small_height small_width"]:
    """Area-averaged by 2^level, then smoothed so that two slices differ less by their focus."""
    size = (max(1, plane.shape[1] >> level), max(1, plane.shape[0] >> level))
    return cv2.GaussianBlur(cv2.resize(plane, size, interpolation=cv2.INTER_AREA), (0, 0), 1.5)


def _at_level(transform: Similarity, level: int) -> Similarity:
    """The same transform in pixels of a picture 2^level times smaller."""
    result = np.array(transform, np.float64)
    result[:, 2] *= 2.0**-level
    return result


def _opencv_centres(transform: Similarity) -> Similarity:
    """From centres at half pixels to OpenCV's, where pixel (0, 0) has its centre at (0, 0)."""
    result = np.array(transform, np.float64)
    result[:, 2] += transform[:, :2] @ [0.5, 0.5] - 0.5
    return result


def _from_opencv_centres(transform: Similarity) -> Similarity:
    result = np.array(transform, np.float64)
    result[:, 2] -= transform[:, :2] @ [0.5, 0.5] - 0.5
    return result


def _ecc(target: Plane, source: Plane, target_from_source: Similarity) -> tuple[Similarity, float]:
    """One level of ECC; OpenCV wants, and returns, source_from_target."""
    start = _opencv_centres(inverse(target_from_source)).astype(np.float32)
    stop = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 60, 1e-6)
    try:
        correlation, found = cv2.findTransformECC(target, source, start, cv2.MOTION_AFFINE, stop)
    except cv2.error:
        return target_from_source, 0.0
    return inverse(_from_opencv_centres(found.astype(np.float64))), float(correlation)
