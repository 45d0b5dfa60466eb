"""The loop over pixels of mrbokeh.srgb_codes."""

import numpy as np
from numba import njit


@njit(cache=True, nogil=True)
def encode(linear: np.ndarray, bits: np.ndarray, first: np.ndarray, thresholds: np.ndarray, shift: int, codes: np.ndarray) -> None:
    """Codes of the values: how many thresholds are not above each. bits: the same values, as the whole numbers that they are stored in.

    first: per value of the bits without the lowest `shift` of them, the code of the least value there; one more at its end, 1 and above.
    """
    last = len(first) - 1
    for i in range(len(linear)):
        value = linear[i]
        if not value > 0.0:  # nothing below, and no NaN
            codes[i] = 0
            continue
        cell = min(bits[i] >> shift, last)
        code = first[cell]
        while code < len(thresholds) and thresholds[code] <= value:
            code += 1
        codes[i] = code
