"""The loop of mrbokeh.layering.sheets, compiled."""

import numpy as np

from mrbokeh.system.kernels import njit


@njit(cache=True, nogil=True)
def put_side_by_side(values: np.ndarray, rgb: np.ndarray, alpha: np.ndarray, margin_px: int, top: int, bottom: int) -> None:
    """Rows top to bottom of rgb (H, W, 3) and alpha (H, W) into the first four channels of values, which has a margin all around."""
    width = alpha.shape[1]
    for y in range(top, bottom):
        for x in range(width):
            pixel = values[margin_px + y, margin_px + x]
            pixel[0], pixel[1], pixel[2], pixel[3] = rgb[y, x, 0], rgb[y, x, 1], rgb[y, x, 2], alpha[y, x]
