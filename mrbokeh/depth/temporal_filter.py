"""Depth of a film, steadied: the depth is filtered, never the picture, so that blur and occlusion hold still where the scene does.

A recursive mean per pixel in dioptres. What changes by more than the noise, which is measured from the film itself, starts afresh, so
that a moving edge does not lag.
"""

from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Bool, Float32

from mrbokeh.system.errors import InputError

Plane = Float32[np.ndarray, "height width"]

_MAD_PER_SIGMA = 0.6745
_VOTES = 3
_NOISE_GROWTH = 1.05
_LEAST_NOISE = 1e-5
_AREA_PX = 7


@dataclass
class TemporalDepthFilter:
    """Frames go in in order; each comes out with the mean of what the same surface showed before.

    gate: a change of more than this many sigmas of the measured noise, seen by a pixel and two of its neighbours, is motion.
    memory: frames over which a still pixel is averaged at most. noise: relative standard deviation, measured so far; None before the
    second frame. It may grow by 5 % a frame only, so that a pan is not taken for noise.
    """

    gate: float = 4.0
    memory: int = 24
    noise: float | None = field(default=None, init=False)
    area_noise: float | None = field(default=None, init=False)
    _mean: Plane | None = field(default=None, init=False, repr=False)
    _count: Plane | None = field(default=None, init=False, repr=False)

    def __post_init__(self) -> None:
        if not self.gate > 0 or self.memory < 1:
            raise InputError(f"expected a gate above 0 and a memory of at least 1 frame, got {self.gate} and {self.memory}")

    def filtered(self, depth_m: Plane) -> Plane:
        """Depth of the next frame (H, W) in metres, inf allowed, steadied. Raises InputError where its size changes."""
        dioptres = (1.0 / depth_m).astype(np.float32)
        if self._mean is None or self._count is None:
            self._mean, self._count = dioptres, np.ones_like(dioptres)
            return depth_m
        if self._mean.shape != dioptres.shape:
            raise InputError(
                f"the depth of a film must keep its size, but went from {self._mean.shape} to {dioptres.shape} (rows, columns)"
            )
        moved = self._moved(dioptres)
        count = np.where(moved, np.float32(1.0), np.minimum(self._count + 1.0, self.memory)).astype(np.float32)
        self._mean = np.where(moved, dioptres, self._mean + (dioptres - self._mean) / count)
        self._count = count
        return _metres(self._mean)

    def _moved(self, dioptres: Plane) -> Bool[np.ndarray, "height width"]:
        """Where the scene changed: a jump of a pixel, or a smaller step of its whole neighbourhood."""
        import cv2

        assert self._mean is not None
        assert self._count is not None
        # Against the mean of n frames, the noise of a new one is larger by sqrt(1 + 1/n).
        level = np.maximum(np.maximum(dioptres, self._mean), 1e-6)
        change = ((dioptres - self._mean) / (level * np.sqrt(1.0 + 1.0 / self._count))).astype(np.float32)
        area = cv2.blur(change, (_AREA_PX, _AREA_PX), borderType=cv2.BORDER_REFLECT)
        self.noise, self.area_noise = _measured(change, self.noise), _measured(area, self.area_noise)
        loud = (np.abs(change) > self.gate * self.noise).astype(np.float32)
        votes = cv2.blur(loud, (3, 3), borderType=cv2.BORDER_REFLECT) * 9.0
        return (votes > _VOTES - 0.5) & (loud > 0) | (np.abs(area) > self.gate * self.area_noise)


def _measured(change: Plane, before: float | None) -> float:
    """Standard deviation from the median, which things that move do not reach while they fill less than half of the picture."""
    found = max(float(np.median(np.abs(change))) / _MAD_PER_SIGMA, _LEAST_NOISE)
    return found if before is None else min(found, _NOISE_GROWTH * before)


def _metres(dioptres: Plane) -> Plane:
    depth_m = np.full(dioptres.shape, np.inf, np.float32)
    np.divide(np.float32(1.0), dioptres, out=depth_m, where=dioptres > 0)
    return depth_m
