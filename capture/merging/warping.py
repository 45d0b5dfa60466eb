"""Slices resampled to the geometry of the reference, and where they have data there."""

import cv2
import numpy as np
from jaxtyping import Bool, Float, Float32

from capture.merging.similarity import Similarity, inverse, moved, to_opencv_centres

_STRIP_ROWS = 128
_MARGIN_PX = 3  # what the cubic kernel and the box around it reach
_BOX = np.ones((3, 3), np.uint8)
_NO_SLOPE = 1e-12

Rgb = Float32[np.ndarray, "height width 3"]


def warp(rgb: Rgb, reference_from_slice: Similarity) -> Rgb:
    """Resample with a cubic kernel that cannot overshoot: beside a bright light the lobes would leave dark holes.

    Where the slice has no data the border pixel goes on. In strips of rows, so that little memory is held beside the result.
    """
    if np.allclose(reference_from_slice, np.eye(2, 3), atol=1e-9):
        return rgb
    out = np.empty_like(rgb)
    for top in range(0, len(rgb), _STRIP_ROWS):
        _warp_rows(rgb, reference_from_slice, top, out[top : top + _STRIP_ROWS])
    return out


def warped_validity(shape: tuple[int, int], reference_from_slice: Similarity) -> Bool[np.ndarray, "height width"]:
    """(H, W) where the reference's pixel centres fall inside the slice, so that `warp` has data there."""
    height, width = shape
    back, y = inverse(reference_from_slice), np.arange(height) + 0.5
    # The slice's pixel centres span 0.5 to width - 0.5; a hair more, so that rounding drops no pixel of an unmoved slice.
    along_x = _run_inside(back[0, 0], back[0, 1] * y + back[0, 2] - width / 2, (width - 1) / 2 + 1e-6)
    along_y = _run_inside(back[1, 0], back[1, 1] * y + back[1, 2] - height / 2, (height - 1) / 2 + 1e-6)
    first = np.ceil(np.maximum(along_x[0], along_y[0]) - 0.5).clip(0, width).astype(np.int32)
    last = np.floor(np.minimum(along_x[1], along_y[1]) - 0.5).clip(-1, width - 1).astype(np.int32)
    columns = np.arange(width, dtype=np.int32)
    return (columns >= first[:, None]) & (columns <= last[:, None])


def _run_inside(slope: float, offsets: Float[np.ndarray, " rows"], reach: float) -> tuple[Float[np.ndarray, " rows"], ...]:
    """Return the least and the greatest x of each row with |slope x + offset| <= reach."""
    slope = float(slope) if abs(slope) > _NO_SLOPE else _NO_SLOPE
    ends = (-reach - offsets) / slope, (reach - offsets) / slope
    return ends if slope > 0 else ends[::-1]


def _warp_rows(rgb: Rgb, reference_from_slice: Similarity, top: int, out: Float32[np.ndarray, "rows width 3"]) -> None:
    """The rows of the result from `top` on, out of those rows of the slice that they need."""
    rows, width = out.shape[:2]
    corners = np.array([[x, y] for x in (0, width) for y in (top, top + rows)], np.float64)
    needed = moved(inverse(reference_from_slice), corners)[:, 1]
    first = int(np.clip(np.floor(needed.min()) - _MARGIN_PX, 0, len(rgb) - 1))
    last = int(np.clip(np.ceil(needed.max()) + _MARGIN_PX, first + 1, len(rgb)))
    matrix = np.array(reference_from_slice, np.float64)
    matrix[:, 2] += matrix[:, :2] @ [0.0, first] - [0.0, top]
    source = np.ascontiguousarray(rgb[first:last])
    lowest = _sampled(cv2.erode(source, _BOX), matrix, out.shape[:2], cv2.INTER_NEAREST)
    highest = _sampled(cv2.dilate(source, _BOX), matrix, out.shape[:2], cv2.INTER_NEAREST)
    np.clip(_sampled(source, matrix, out.shape[:2], cv2.INTER_CUBIC), lowest, highest, out=out)


def _sampled(image: Rgb, matrix: Similarity, shape: tuple[int, ...], method: int) -> Float32[np.ndarray, "rows width 3"]:
    size = (shape[1], shape[0])
    return cv2.warpAffine(image, to_opencv_centres(matrix), size, flags=method, borderMode=cv2.BORDER_REPLICATE)
