"""The loop over the pixels of an Overlay on 8-bit codes, compiled; it runs without the GIL."""

import numpy as np

from mrbokeh.system.kernels import njit


@njit(cache=True, nogil=True)
def over_codes(
    bgr: np.ndarray,
    top: int,
    left: int,
    rgb: np.ndarray,
    shines_through: np.ndarray,
    linear_from_code: np.ndarray,
    code_from_linear: np.ndarray,
) -> None:
    """Premultiplied "over" in linear light, in place on bgr (H, W, 3) uint8."""
    height, width = shines_through.shape
    steps = np.float32(len(code_from_linear) - 1)
    for j in range(height):
        for i in range(width):
            kept = shines_through[j, i]
            for c in range(3):
                light = rgb[j, i, 2 - c]
                if kept == 1.0 and light == 0.0:
                    continue
                linear = light + kept * linear_from_code[bgr[top + j, left + i, c]]
                position = min(max(linear, np.float32(0.0)), np.float32(1.0)) * steps
                bgr[top + j, left + i, c] = code_from_linear[int(position + np.float32(0.5))]
