"""Where the slices contradict the depth: a Gauss-Newton step of the depth of every neighbourhood, over all slices together.

A depth that is off by e dioptres changes the diameter of every slice by its growth times e, all in one direction. Noise, occlusion
and movement do not keep to that.
"""

from dataclasses import dataclass, field

import cv2
import numpy as np
from jaxtyping import Bool, Float32

from capture.report.slice_fit import Prediction

Rgb = Float32[np.ndarray, "height width 3"]
Plane = Float32[np.ndarray, "height width"]
Mask = Bool[np.ndarray, "height width"]

_NEIGHBOURHOOD_PX = 6.0
_DARK = 0.02
_SIGMAS = 4.0


@dataclass(frozen=True)
class DepthCheck:
    """off_px: (H, W) by how many pixels of diameter depth is wrong in the slices, 0 where they do not tell. told: (H, W) they do."""

    off_px: Plane
    told: Mask

    def share_beyond(self, limit_px: float) -> float:
        """Return the share of the pixels that tell whose circles of confusion are off by more."""
        return float((np.abs(self.off_px) > limit_px)[self.told].mean()) if self.told.any() else 0.0


@dataclass
class DepthEvidence:
    """Sums over slices, one slice at a time."""

    _pulls: list[Plane] = field(default_factory=list)
    _weights: list[Plane] = field(default_factory=list)
    _squares: list[Plane] = field(default_factory=list)

    def add(self, remaining: Rgb, prediction: Prediction, counted: Mask) -> None:
        """remaining: slice minus prediction, after what holds for the whole slice was taken out."""
        weight = (counted / (_DARK + np.maximum(prediction.rgb.mean(axis=2), 0.0)))[..., None].astype(np.float32)
        per_px = prediction.per_px
        pull = (weight * per_px * remaining).sum(axis=2)
        self._accumulate(self._pulls, pull)
        self._accumulate(self._weights, (weight * per_px**2).sum(axis=2))
        self._accumulate(self._squares, pull**2)

    def check(self) -> DepthCheck:
        if not self._pulls:
            raise ValueError("no slice was added")
        pull, weight, square = (
            cv2.GaussianBlur(each[0], (0, 0), _NEIGHBOURHOOD_PX) for each in (self._pulls, self._weights, self._squares)
        )
        off_px = -pull / np.maximum(weight, 1e-12)
        # Of the mean of n independent pulls the deviation is that of one over sqrt(n); a Gaussian window holds 4 pi s^2 of them.
        pixels = 4.0 * np.pi * _NEIGHBOURHOOD_PX**2
        error_px = np.sqrt(square / pixels) / np.maximum(weight, 1e-12)
        informed = weight > 0.05 * np.quantile(weight, 0.9)
        told = informed & (weight > 0)
        return DepthCheck(np.where(told & (np.abs(off_px) > _SIGMAS * error_px), off_px, 0.0).astype(np.float32), told)

    @staticmethod
    def _accumulate(sums: list[Plane], plane: Plane) -> None:
        if sums:
            sums[0] += plane
        else:
            sums.append(plane.astype(np.float32))
