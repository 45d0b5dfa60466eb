"""Similarities of the picture plane (scale, rotation, shift) in pixels, with (0.5, 0.5) at the centre of the first pixel."""

import numpy as np
from jaxtyping import Float

Similarity = Float[np.ndarray, "2 3"]


def scale_of(similarity: Similarity) -> float:
    return float(np.hypot(similarity[0, 0], similarity[1, 0]))


def about_centre(scale: float, width_px: int, height_px: int) -> Similarity:
    """Scaling about the centre of the picture."""
    return np.array([[scale, 0.0, (1 - scale) * width_px / 2], [0.0, scale, (1 - scale) * height_px / 2]])


def scaled_about(pivot_px: Float[np.ndarray, "2"], similarity: Similarity, scale: float) -> Similarity:
    """The similarity with another scale that takes the pivot where it went before."""
    turn = similarity[:, :2] * (scale / scale_of(similarity))
    return np.column_stack([turn, moved(similarity, pivot_px[None])[0] - turn @ pivot_px])


def chained(outer: Similarity, inner: Similarity) -> Similarity:
    """First `inner`, then `outer`."""
    return np.column_stack([outer[:, :2] @ inner[:, :2], outer[:, :2] @ inner[:, 2] + outer[:, 2]])


def inverse(similarity: Similarity) -> Similarity:
    back = np.linalg.inv(similarity[:, :2])
    return np.column_stack([back, -back @ similarity[:, 2]])


def moved(similarity: Similarity, xy_px: Float[np.ndarray, "points 2"]) -> Float[np.ndarray, "points 2"]:
    """Where points go."""
    return xy_px @ similarity[:, :2].T + similarity[:, 2]


def as_similarity(affine: Similarity, width_px: int, height_px: int) -> Similarity:
    """The similarity nearest to an affine transform over a picture: both take its centre to the same place."""
    a, b = 0.5 * (affine[0, 0] + affine[1, 1]), 0.5 * (affine[1, 0] - affine[0, 1])
    turn, centre = np.array([[a, -b], [b, a]]), np.array([width_px / 2, height_px / 2])
    return np.column_stack([turn, affine[:, :2] @ centre + affine[:, 2] - turn @ centre])


def farthest_corner_px(a: Similarity, b: Similarity, width_px: int, height_px: int) -> float:
    """How far apart two transforms take a corner of the picture."""
    corners = np.array([[x, y, 1.0] for x in (0, width_px) for y in (0, height_px)])
    return float(np.hypot(*((a - b) @ corners.T)).max())


def at_level(transform: Similarity, level: int) -> Similarity:
    """The same transform in pixels of a picture 2^level times smaller (negative: larger)."""
    return at_scale(transform, 2.0**-level)


def at_scale(transform: Similarity, scale: float) -> Similarity:
    """Return the same transform in pixels of a picture of another size."""
    result = np.array(transform, np.float64)
    result[:, 2] *= scale
    return result


def to_opencv_centres(transform: Similarity) -> Similarity:
    """From centres at half pixels to OpenCV's, where pixel (0, 0) has its centre at (0, 0)."""
    result = np.array(transform, np.float64)
    result[:, 2] += transform[:, :2] @ [0.5, 0.5] - 0.5
    return result


def from_opencv_centres(transform: Similarity) -> Similarity:
    result = np.array(transform, np.float64)
    result[:, 2] -= transform[:, :2] @ [0.5, 0.5] - 0.5
    return result
