"""Where in the stack things are sharp: whether the slices reach from the nearest to the farthest thing."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Float32

Plane = Float32[np.ndarray, "height width"]

_TRUSTED = 0.3


@dataclass(frozen=True)
class FocusCurve:
    """shares: of the pixels whose focus can be trusted, how many are sharpest in each slice. trusted: share of pixels that can be.
    beyond_near, beyond_far: shares of them whose focus lies at the very first and last slice, so that the true one may lie beyond.
    """

    shares: Float[np.ndarray, " slices"]
    trusted: float
    beyond_near: float
    beyond_far: float


_AT_THE_END = 0.1


def focus_curve(focus_index: Plane, confidence: Plane, slices: int, least_confidence: float = _TRUSTED) -> FocusCurve:
    trusted = confidence >= least_confidence
    index = focus_index[trusted]
    if index.size == 0:
        return FocusCurve(np.zeros(slices), 0.0, 0.0, 0.0)
    counts = np.bincount(np.clip(np.round(index), 0, slices - 1).astype(int), minlength=slices)
    return FocusCurve(
        counts / index.size,
        float(trusted.mean()),
        float((index <= _AT_THE_END).mean()),
        float((index >= slices - 1 - _AT_THE_END).mean()),
    )
