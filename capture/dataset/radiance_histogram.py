"""How bright the pictures of a data set are: a histogram of radiance that takes pictures in bands and never holds them all."""

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Bool, Float, Int64

from mrbokeh.stacks.focal_stack_dataset import RadianceRange

QUANTILES = ("0.5", "0.99", "0.999", "0.9999")
_LOWEST_STOP, _STOPS, _PER_STOP = -16, 40, 128


@dataclass
class RadianceHistogram:
    """Of the largest channel of pixels, in steps of 1/128 stop (0.5 %); below 2^-16 all are one. largest: exact."""

    largest: float = 0.0
    _counts: Int64[np.ndarray, " bins"] = field(default_factory=lambda: np.zeros(_STOPS * _PER_STOP, np.int64))

    def add(self, rgb: Float[np.ndarray, "height width 3"], counted: Bool[np.ndarray, "height width"]) -> None:
        peak = rgb.max(axis=2)[counted]
        if peak.size:
            self.largest = max(self.largest, float(peak.max()))
            steps = (np.log2(np.maximum(peak, 2.0**_LOWEST_STOP)) - _LOWEST_STOP) * _PER_STOP
            self._counts += np.bincount(np.minimum(steps.astype(np.int64), len(self._counts) - 1), minlength=len(self._counts))

    def quantile(self, share: float) -> float:
        """The upper edge of the step below which this share of the pixels lies."""
        total = int(self._counts.sum())
        if total == 0:
            return 0.0
        step = int(np.searchsorted(np.cumsum(self._counts), share * total)) + 1
        return min(2.0 ** (_LOWEST_STOP + step / _PER_STOP), self.largest)

    def radiance_range(self, quantiles: Sequence[str] = QUANTILES) -> RadianceRange:
        return RadianceRange(self.largest, {each: self.quantile(float(each)) for each in quantiles})
