"""The loop over pixels of mrbokeh.layering.pixel_box."""

import numpy as np

from mrbokeh.system.kernels import njit


@njit(cache=True, nogil=True, error_model="numpy", _nrt=False)
def widen(box: np.ndarray, flat: np.ndarray, channels: int) -> None:
    """Widen the box (top, bottom, left, right) by all pixels of rows (H, W * channels) that are not 0."""
    height, count = flat.shape
    for y in range(height):
        touched = 0
        for i in range(count):  # without a way out, so that it runs on whole vectors
            touched += flat[y, i] != 0.0
        if touched == 0:
            continue
        first, last = 0, count - 1
        while flat[y, first] == 0.0:
            first += 1
        while flat[y, last] == 0.0:
            last -= 1
        box[0], box[1] = min(box[0], y), max(box[1], y + 1)
        box[2], box[3] = min(box[2], first // channels), max(box[3], last // channels + 1)
