"""Plane transforms in pixels, with (0.5, 0.5) at the centre of the first pixel, and pictures resampled by them.

Two rows are a similarity (scale, rotation, shift). A camera in the hand also turns between slices, and pictures of a wide lens then differ
by a perspective: three rows are a homography whose last element is 1.
"""

from collections.abc import Callable

import cv2
import numpy as np
from jaxtyping import Bool, Float, Float32

_STRIP_ROWS = 128
_MARGIN_PX = 3  # what the cubic kernel and the box around it reach
_BOX = np.ones((3, 3), np.uint8)
_NO_SLOPE = 1e-12

Transform = Float[np.ndarray, "_ 3"]
Rgb = Float32[np.ndarray, "height width 3"]
Sampled = Float32[np.ndarray, "_ _ ..."]


def warp(rgb: Rgb, reference_from_slice: Transform, prepared: Callable[[Rgb], Rgb] | None = None) -> Rgb:
    """Resample a slice to the geometry of the reference, with a cubic kernel that cannot overshoot.

    Beside a bright light the lobes of the kernel would leave dark holes. Beyond the slice its border pixels go on. Works in strips of rows,
    so that little memory is held beside the result. prepared: is applied to the pixels before, strip by strip.
    """
    if not is_perspective(reference_from_slice) and np.allclose(reference_from_slice, np.eye(2, 3), atol=1e-9):
        return rgb if prepared is None else prepared(rgb)
    out = np.empty_like(rgb)
    for top in range(0, len(rgb), _STRIP_ROWS):
        _warp_rows(rgb, reference_from_slice, top, out[top : top + _STRIP_ROWS], prepared)
    return out


def warped_validity(shape: tuple[int, int], reference_from_slice: Transform) -> Bool[np.ndarray, "height width"]:
    """Return (H, W) whether the centres of the reference's pixels fall inside the slice, so that `warp` has data there."""
    height, width = shape
    back, y = inverse(reference_from_slice), np.arange(height) + 0.5
    denominator = back[2] if is_perspective(back) else np.array([0.0, 0.0, 1.0])
    first, last = np.full(height, -np.inf), np.full(height, np.inf)
    for along, size in zip(back[:2], (width, height), strict=True):
        # The slice's pixel centres span 0.5 to size - 0.5; a hair more, so that rounding drops no pixel of an unmoved slice.
        middle, reach = along - 0.5 * size * denominator, (0.5 * (size - 1) + 1e-6) * denominator
        for slope, by_y, offset in (reach + middle, reach - middle):
            slope = float(slope) if abs(slope) > _NO_SLOPE else _NO_SLOPE
            end = -(by_y * y + offset) / slope
            if slope > 0:
                first = np.maximum(first, end)
            else:
                last = np.minimum(last, end)
    first, last = np.ceil(first - 0.5).clip(0, width).astype(np.int32), np.floor(last - 0.5).clip(-1, width - 1).astype(np.int32)
    columns = np.arange(width, dtype=np.int32)
    return (columns >= first[:, None]) & (columns <= last[:, None])


def is_perspective(transform: Transform) -> bool:
    return len(transform) == 3


def middle_of(size_px: tuple[int, int]) -> tuple[float, float]:
    return 0.5 * size_px[0], 0.5 * size_px[1]


def scale_of(transform: Transform, at_px: tuple[float, float] = (0.0, 0.0)) -> float:
    """Return the factor by which lengths grow at a point; a similarity enlarges all points alike."""
    if not is_perspective(transform):
        return float(np.hypot(transform[0, 0], transform[1, 0]))
    # Of a homography the determinant of the derivative is that of the matrix over the cube of the denominator.
    return float(np.sqrt(np.linalg.det(transform) / (transform[2] @ [*at_px, 1.0]) ** 3))


def about_centre(scale: float, width_px: int, height_px: int) -> Transform:
    """Return a scaling about the centre of the picture."""
    return np.array([[scale, 0.0, (1 - scale) * width_px / 2], [0.0, scale, (1 - scale) * height_px / 2]])


def scaled_about(pivot_px: Float[np.ndarray, "2"], similarity: Transform, scale: float) -> Transform:
    """Return the similarity with another scale that takes the pivot where it went before."""
    turn = similarity[:, :2] * (scale / scale_of(similarity))
    return np.column_stack([turn, moved(similarity, pivot_px[None])[0] - turn @ pivot_px])


def chained(outer: Transform, inner: Transform) -> Transform:
    """Return the transform that applies `inner` first, then `outer`."""
    return _reduced(_square(outer) @ _square(inner))


def inverse(transform: Transform) -> Transform:
    return _reduced(np.linalg.inv(_square(transform)))


def moved(transform: Transform, xy_px: Float[np.ndarray, "points 2"]) -> Float[np.ndarray, "points 2"]:
    """Return the points after the transform."""
    ends = xy_px @ transform[:2, :2].T + transform[:2, 2]
    return ends / (xy_px @ transform[2, :2] + transform[2, 2])[:, None] if is_perspective(transform) else ends


def as_similarity(affine: Transform, width_px: int, height_px: int) -> Transform:
    """Return the similarity nearest to an affine transform over a picture: both take its centre to the same place."""
    a, b = 0.5 * (affine[0, 0] + affine[1, 1]), 0.5 * (affine[1, 0] - affine[0, 1])
    turn, centre = np.array([[a, -b], [b, a]]), np.array([width_px / 2, height_px / 2])
    return np.column_stack([turn, affine[:, :2] @ centre + affine[:, 2] - turn @ centre])


def farthest_corner_px(a: Transform, b: Transform, width_px: int, height_px: int) -> float:
    """Return the largest distance between the places to which two transforms take a corner of the picture."""
    corners = np.array([[x, y] for x in (0.0, width_px) for y in (0.0, height_px)])
    return float(np.hypot(*(moved(a, corners) - moved(b, corners)).T).max())


def at_level(transform: Transform, level: int) -> Transform:
    """Return the same transform in pixels of a picture 2^level times smaller (negative: larger)."""
    return at_scale(transform, 2.0**-level)


def at_scale(transform: Transform, scale: float) -> Transform:
    """Return the same transform in pixels of a picture of another size."""
    result = np.array(transform, np.float64)
    result[:2, 2] *= scale
    result[2:, :2] /= scale
    return result


def to_opencv_centres(transform: Transform) -> Transform:
    """Convert from centres at half pixels to OpenCV's, where pixel (0, 0) has its centre at (0, 0)."""
    return _about(transform, 0.5)


def from_opencv_centres(transform: Transform) -> Transform:
    """Convert from OpenCV's centres to centres at half pixels."""
    return _about(transform, -0.5)


def sampled(image: Sampled, transform: Transform, size: tuple[int, int], **options: int | float) -> Sampled:
    """Return a picture of (width, height) that a transform has moved. options: of cv2.warpAffine."""
    warp_by = cv2.warpPerspective if is_perspective(transform) else cv2.warpAffine
    return np.asarray(warp_by(image, to_opencv_centres(transform), size, **options))  # type: ignore[call-overload]


def _warp_rows(
    rgb: Rgb, reference_from_slice: Transform, top: int, out: Float32[np.ndarray, "rows width 3"], prepared: Callable[[Rgb], Rgb] | None
) -> None:
    """Fill `out`, the rows of the result from `top` on, from the rows of the slice that they need."""
    rows, width = out.shape[:2]
    corners = np.array([[x, y] for x in (0, width) for y in (top, top + rows)], np.float64)
    needed = moved(inverse(reference_from_slice), corners)[:, 1]
    first = int(np.clip(np.floor(needed.min()) - _MARGIN_PX, 0, len(rgb) - 1))
    last = int(np.clip(np.ceil(needed.max()) + _MARGIN_PX, first + 1, len(rgb)))
    matrix = chained(_down(-top), chained(reference_from_slice, _down(first)))
    source = np.ascontiguousarray(rgb[first:last]) if prepared is None else prepared(rgb[first:last])
    lowest = _sampled(cv2.erode(source, _BOX), matrix, out.shape[:2], cv2.INTER_NEAREST)
    highest = _sampled(cv2.dilate(source, _BOX), matrix, out.shape[:2], cv2.INTER_NEAREST)
    np.clip(_sampled(source, matrix, out.shape[:2], cv2.INTER_CUBIC), lowest, highest, out=out)


def _down(rows: int) -> Transform:
    return np.array([[1.0, 0.0, 0.0], [0.0, 1.0, rows]])


def _sampled(image: Rgb, matrix: Transform, shape: tuple[int, ...], method: int) -> Float32[np.ndarray, "rows width 3"]:
    return sampled(image, matrix, (shape[1], shape[0]), flags=method, borderMode=cv2.BORDER_REPLICATE)


def _square(transform: Transform) -> Float[np.ndarray, "3 3"]:
    return np.array(transform, np.float64) if is_perspective(transform) else np.vstack([transform, [0.0, 0.0, 1.0]])


def _reduced(matrix: Float[np.ndarray, "3 3"]) -> Transform:
    """Return a homography with a last element of 1, or its two rows if it has no perspective."""
    return matrix / matrix[2, 2] if (matrix[2, :2] != 0.0).any() else matrix[:2] / matrix[2, 2]


def _about(transform: Transform, origin_px: float) -> Transform:
    """Return the same transform with the origin at (origin_px, origin_px)."""
    shift = np.array([[1.0, 0.0, origin_px], [0.0, 1.0, origin_px]])
    return chained(inverse(shift), chained(transform, shift))
