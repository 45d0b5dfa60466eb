"""The compiled loop of `exr_rows`."""

import numpy as np

from mrbokeh.system.compiled import njit


@njit(cache=True, nogil=True)
def without_prediction(packed: np.ndarray) -> np.ndarray:
    """Undo the prediction of OpenEXR's ZIP blocks: bytes are stored as differences from the last, plus 128, even ones before odd ones."""
    result = np.empty(packed.size, np.uint8)
    half, value = (packed.size + 1) // 2, 128
    for i in range(half):
        value = (value + packed[i] + 128) & 255
        result[2 * i] = value
    for i in range(half, packed.size):
        value = (value + packed[i] + 128) & 255
        result[2 * (i - half) + 1] = value
    return result
