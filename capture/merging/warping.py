"""Slices resampled to the geometry of the reference, and where they have data there."""

from collections.abc import Callable

import cv2
import numpy as np
from jaxtyping import Bool, Float32

from capture.merging.plane_transforms import Transform, chained, inverse, is_perspective, moved, to_opencv_centres

_STRIP_ROWS = 128
_MARGIN_PX = 3  # what the cubic kernel and the box around it reach
_BOX = np.ones((3, 3), np.uint8)
_NO_SLOPE = 1e-12

Rgb = Float32[np.ndarray, "height width 3"]
Sampled = Float32[np.ndarray, "_ _ ..."]


def warp(rgb: Rgb, reference_from_slice: Transform, prepared: Callable[[Rgb], Rgb] | None = None) -> Rgb:
    """Resample with a cubic kernel that cannot overshoot: beside a bright light the lobes would leave dark holes.

    Where the slice has no data the border pixel goes on. In strips of rows, so that little memory is held beside the result.
    prepared: what is done to the pixels before, rows by rows.
    """
    if not is_perspective(reference_from_slice) and np.allclose(reference_from_slice, np.eye(2, 3), atol=1e-9):
        return rgb if prepared is None else prepared(rgb)
    out = np.empty_like(rgb)
    for top in range(0, len(rgb), _STRIP_ROWS):
        _warp_rows(rgb, reference_from_slice, top, out[top : top + _STRIP_ROWS], prepared)
    return out


def warped_validity(shape: tuple[int, int], reference_from_slice: Transform) -> Bool[np.ndarray, "height width"]:
    """(H, W) where the reference's pixel centres fall inside the slice, so that `warp` has data there."""
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


def _warp_rows(
    rgb: Rgb, reference_from_slice: Transform, top: int, out: Float32[np.ndarray, "rows width 3"], prepared: Callable[[Rgb], Rgb] | None
) -> None:
    """The rows of the result from `top` on, out of those rows of the slice that they need."""
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


def sampled(image: Sampled, transform: Transform, size: tuple[int, int], **options: int | float) -> Sampled:
    """Return a picture of (width, height) that a transform has moved; options: of cv2.warpAffine."""
    warp_by = cv2.warpPerspective if is_perspective(transform) else cv2.warpAffine
    return np.asarray(warp_by(image, to_opencv_centres(transform), size, **options))  # type: ignore[call-overload]
