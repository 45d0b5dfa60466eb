"""Where a photograph may have out-of-focus lights: compact parts above levels of light that step down."""

from collections.abc import Iterator

import numpy as np
from jaxtyping import Float32

LARGEST_ASPECT = 2.6
_LARGEST_SHARE = 0.45  # of the shorter side of the frame
_LEVELS = 14
_BORDER_PX = 2

Box = tuple[int, int, int, int]


def bright_parts(grey: Float32[np.ndarray, "height width"], least_px: float) -> Iterator[Box]:
    """Boxes (left, top, width, height), clear of the border, from levels between the brightest light and near the median."""
    import cv2

    smooth = cv2.GaussianBlur(grey, (0, 0), 0.8)
    bright, dark = float(np.percentile(smooth, 99.97)), float(np.median(smooth))
    lowest = max(1.3 * dark, 2e-3 * bright, 1e-6)
    seen: set[Box] = set()
    for level in np.geomspace(0.9 * bright, lowest, _LEVELS) if bright > lowest else ():
        _, _, parts, _ = cv2.connectedComponentsWithStats((smooth > level).astype(np.uint8), connectivity=4)
        for left, top, wide, high, area in parts[1:].tolist():
            box = (left, top, wide, high)
            if box not in seen and area >= 0.5 * wide * high and _is_sized(box, grey.shape, least_px):
                seen.add(box)
                yield box


def _is_sized(box: Box, frame: tuple[int, ...], least_px: float) -> bool:
    left, top, wide, high = box
    height, width = frame
    clear = min(left, top) > _BORDER_PX and left + wide < width - _BORDER_PX and top + high < height - _BORDER_PX
    return (
        clear
        and min(wide, high) >= least_px
        and max(wide, high) <= min(_LARGEST_SHARE * min(height, width), LARGEST_ASPECT * min(wide, high))
    )
