"""DepthMap: depth of a photograph, pixel by pixel; DepthSettings: what the user states of a map that does not say it itself."""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float, Float32

from mrbokeh.system.errors import InputError
from mrbokeh.system.typed_numbers import numbers_in

GIVES = ("inverse", "metric")
"""Outputs of depth networks: numbers that grow with 1 / depth up to scale and offset, or metres."""


@dataclass(frozen=True)
class KnownDistance:
    """Measured distance of what is seen at a pixel of the photograph."""

    x_px: float
    y_px: float
    depth_m: float


@dataclass(frozen=True)
class StereoCalibration:
    """Stereo cameras: depth = focal_px * baseline_m / (disparity + offset_px); the offset is the difference of the principal points
    (doffs).
    """

    focal_px: float
    baseline_m: float
    offset_px: float = 0.0


@dataclass(frozen=True)
class DepthSettings:
    """Statements of the user about a depth map.

    near_far_m: what the largest and the smallest number of a map linear in dioptres mean; inf is allowed for the far one.
    metres_per_unit: an integer file holds depth, 0 is unknown. stereo: of a disparity file. model_gives, known: of a network.
    refined: a map smaller than the photograph is enlarged along its edges; None: if the source is known to be soft. exact: nothing is
    mended (`mrbokeh.depth.mended_depth`).
    """

    near_far_m: tuple[float, float] | None = None
    metres_per_unit: float | None = None
    stereo: StereoCalibration | None = None
    model_gives: str = "inverse"
    known: tuple[KnownDistance, ...] = ()
    refined: bool | None = None
    exact: bool = False

    def __post_init__(self) -> None:
        if self.near_far_m is not None and not 0 < self.near_far_m[0] < self.near_far_m[1]:
            raise InputError(f"expected the nearest and the farthest distance in metres, 0 < NEAR < FAR, got {self.near_far_m}")
        if self.metres_per_unit is not None and not self.metres_per_unit > 0:
            raise InputError(f"expected how many metres one step of the depth file means, above 0, got {self.metres_per_unit}")
        if self.model_gives not in GIVES:
            raise InputError(f"expected a depth network to give 'inverse' or 'metric' depth, got {self.model_gives!r}")


def parse_near_far(text: str) -> tuple[float, float]:
    """Parse NEAR:FAR in metres, such as 0.5:inf."""
    near, far = numbers_in(text, "--disparity: expected NEAR:FAR in metres, such as 0.5:8 or 0.5:inf", (2,), separator=":")
    return near, far


def parse_stereo(text: str) -> StereoCalibration:
    """Parse FOCAL_PX,BASELINE_M or FOCAL_PX,BASELINE_M,OFFSET_PX."""
    return StereoCalibration(*numbers_in(text, "--stereo-cameras: expected FOCAL_PX,BASELINE_M or FOCAL_PX,BASELINE_M,OFFSET_PX", (2, 3)))


def parse_known(text: str) -> KnownDistance:
    """Parse X,Y,METRES."""
    known = KnownDistance(*numbers_in(text, "--distance-at: expected X,Y,METRES of a pixel whose distance is known", (3,)))
    if not known.depth_m > 0:
        raise InputError(f"expected a known distance above 0 m, got {text!r}")
    return known


Plane = Float32[np.ndarray, "height width"]
Mask = Bool[np.ndarray, "height width"]


@dataclass(frozen=True)
class DepthMap:
    """Depth of a photograph, pixel by pixel.

    depth_m: (H, W) along the optical axis, above 0, inf is background. valid: (H, W) where it was measured; elsewhere it was
    filled in, or is the depth of the nearest place where it was. note: where it comes from, for people.
    """

    depth_m: Plane
    valid: Mask
    note: str

    @property
    def dioptres(self) -> Plane:
        return (1.0 / self.depth_m).astype(np.float32)

    @classmethod
    def of_dioptres(cls, dioptres: Float[np.ndarray, "height width"], valid: Mask, note: str) -> "DepthMap":
        """Return the depth of dioptres; values not above 0 lie at infinity."""
        near = dioptres > 0
        depth_m = np.full(dioptres.shape, np.inf, np.float32)
        np.divide(1.0, dioptres, out=depth_m, where=near, casting="same_kind")
        return cls(depth_m, valid, note)

    @classmethod
    def of_levels(cls, levels: Plane, near_far_m: tuple[float, float], valid: Mask, note: str) -> "DepthMap":
        """Return the depth of levels that are linear in dioptres: 1 is the nearest distance, 0 the farthest."""
        near_m, far_m = near_far_m
        dioptres = levels / near_m + (1.0 - levels) / far_m
        return cls.of_dioptres(dioptres.astype(np.float32), valid, f"{note}, {near_m:g} to {far_m:g} m")


_TERRACE_PX, _TERRACE_STEPS, _JOINT_SIGMA_PX = 24.0, 8.0, 2.0
"""How far, and over how many steps, terraces are smoothed, and their joints."""


def without_steps(levels: Plane, steps: int) -> Plane:
    """Return levels in [0, 1] as smooth as they can have been before they were rounded to so many steps; more than 256 stay as they are.

    Smoothing ends at edges (domain transform), each pixel stays within a step of its level (half of it was rounded, JPEG adds as much),
    and 0 and 1, which mean unknown or beyond the range, stay. In 8 bit a slanted surface falls into terraces, and the background shows
    through their joints when they are blurred.
    """
    import cv2

    if steps > 256:
        return levels
    step, guide = np.float32(1.0 / (steps - 1)), levels * np.float32(steps - 1)
    smooth = cv2.ximgproc.dtFilter(guide, levels, _TERRACE_PX, _TERRACE_STEPS, mode=cv2.ximgproc.DTF_RF, numIters=3)
    for _ in range(2):
        # What the filter leaves of each joint.
        smooth = cv2.GaussianBlur(np.clip(smooth, levels - step, levels + step), (0, 0), _JOINT_SIGMA_PX)
    smooth = np.clip(smooth, levels - step, levels + step)
    return np.where((levels > 0.0) & (levels < 1.0), smooth, levels).astype(np.float32)


def with_holes_filled(depth: DepthMap) -> DepthMap:
    """Give pixels that were not measured the depth of the nearest measured one."""
    if depth.valid.all() or not depth.valid.any():
        return depth
    from scipy.ndimage import distance_transform_edt

    rows, columns = distance_transform_edt(~depth.valid, return_distances=False, return_indices=True)
    return replace(depth, depth_m=depth.depth_m[rows, columns])
