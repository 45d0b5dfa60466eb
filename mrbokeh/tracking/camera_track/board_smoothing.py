"""Poses of a whole shot smoothed without lag, as strongly as the scatter of the board's corners leaves them open, and no more.

Six parameters fitted to n corners that are each off by r px are themselves off by r sqrt(6 / 2n) px in the picture (RMS). The strongest
splines are taken whose poses move the picture of the board by no more: noise goes, and the trembling of a hand, which the plate
shows too, stays.

The splines are smoothing splines on the frame grid (Whittaker 1923, with third differences; Eilers 2003), for the rotation, for where the
camera sees the board's middle, and for how far off that is; filtered as a pose's last column, turn and shift would let objects swim.
Missing frames are bridged by the same splines. A criterion that looks at the poses alone (generalised cross-validation was tried) takes
the trembling of a hand for noise, and doubled the error of a traced clip.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float64
from scipy.linalg import solveh_banded
from scipy.spatial.transform import Rotation

from mrbokeh.optics.camera import Camera
from mrbokeh.tracking.charuco.detector import Corners
from mrbokeh.tracking.charuco.flat_prints import FlatPrint

Pose = Float64[np.ndarray, "4 4"]
Values = Float64[np.ndarray, "frames channels"]
Weights = Float64[np.ndarray, " frames"]

_ORDER = 3
_CALM = 100.0


def steady_poses(
    poses: Mapping[int, Pose], weights: Mapping[int, float], pivot_m: Float64[np.ndarray, "3"], strength: float
) -> dict[int, Pose]:
    """Return camera_from_world of every frame from the first to the last of `poses`, smoothed.

    weights: of the same frames, any unit; about 1 / variance.
    pivot_m: the world point whose direction and distance are smoothed, the middle of what was seen. strength: see `whittaker`, for
      weights of 1 at the best frame; 1 smooths over about 3 frames, 1e6 over about 30, towards 0 only gaps are filled.
    """
    numbers = np.arange(min(poses), max(poses) + 1)
    if len(poses) <= _ORDER:
        return dict(poses)
    there = np.array([int(number) in poses for number in numbers])
    known = [poses[int(number)] for number in numbers[there]]
    weight = np.zeros(len(numbers))
    weight[there] = [weights[int(number)] for number in numbers[there]]
    seen = np.array([pose[:3, :3] @ pivot_m + pose[:3, 3] for pose in known])
    channels = np.column_stack([_quaternions(known), seen[:, :2] / seen[:, 2:], np.log(seen[:, 2:])])
    smooth = _bridged(_filled(channels, there), weight / weight.max(), strength)
    return {int(number): _pose(row, pivot_m) for number, row in zip(numbers, smooth, strict=True)}


def _bridged(values: Values, weights: Weights, strength: float) -> Values:
    """Smooth, and bridge gaps by a calm spline that is moved to meet both ends: a weak one would swing with the trembling at its ends."""
    smooth, there = whittaker(values, weights, strength), weights > 0
    calm = whittaker(values, weights, max(strength, _CALM))
    meeting = calm + _filled((smooth - calm)[there], there)
    return np.where(there[:, None], smooth, meeting)


def whittaker(values: Values, weights: Weights, strength: float) -> Values:
    """Return the z that minimises sum of weights (values - z)^2 + strength times the sum of squared third differences of z."""
    count = len(values)
    bands = strength * _penalty_bands(count)
    bands[-1] += np.maximum(weights, 1e-9)
    return np.asarray(solveh_banded(bands, weights[:, None] * values))


def _penalty_bands(count: int) -> Float64[np.ndarray, "bands frames"]:
    """Return the upper bands of D'D with D the third differences, as solveh_banded has them."""
    differences = np.diff(np.eye(min(count, 4 * _ORDER)), _ORDER, axis=0)
    small = differences.T @ differences
    bands = np.zeros((_ORDER + 1, count))
    edge = len(small) // 2
    for band in range(_ORDER + 1):
        diagonal = np.diagonal(small, band)
        whole = np.full(count - band, diagonal[len(diagonal) // 2])
        if count > len(small):
            whole[:edge], whole[-edge:] = diagonal[:edge], diagonal[-edge:]
        else:
            whole = diagonal
        bands[_ORDER - band, band:] = whole
    return bands


def _quaternions(poses: list[Pose]) -> Values:
    """Return quaternions without sign changes between neighbours."""
    turns = Rotation.from_matrix(np.array([pose[:3, :3] for pose in poses])).as_quat()
    signs = np.cumprod(np.where(np.sum(turns[1:] * turns[:-1], axis=1) < 0, -1.0, 1.0))
    return turns * np.concatenate([[1.0], signs])[:, None]


def _filled(values: Float64[np.ndarray, "known channels"], there: Bool[np.ndarray, " frames"]) -> Values:
    """Fill missing rows along lines; they only start the splines, with a weight of 0."""
    places, known = np.arange(len(there)), np.flatnonzero(there)
    return np.stack([np.interp(places, known, channel) for channel in values.T], axis=1)


def _pose(row: np.ndarray, pivot_m: np.ndarray) -> Pose:
    """Return the pose of a row: quaternion, direction, logarithm of the distance."""
    pose = np.eye(4)
    pose[:3, :3] = Rotation.from_quat(row[:4]).as_matrix()
    pose[:3, 3] = np.exp(row[6]) * np.array([row[4], row[5], 1.0]) - pose[:3, :3] @ pivot_m
    return pose


_WEAKEST, _STRONGEST, _STEP = 1e-4, 1e7, 2.0


@dataclass(frozen=True)
class Observation:
    """Measured pose of one frame, and the corners that it explains."""

    pose: Pose
    corners: Corners


def steadied(observed: Mapping[int, Observation], board: FlatPrint, camera: Camera, extra_px: float = 0.0) -> dict[int, Pose]:
    """Return camera_from_world of all frames from the first to the last that was observed, smoothed as far as their scatter allows.

    extra_px: RMS by which they may move further.
    """
    measured = {number: each.pose for number, each in observed.items()}
    weights = {number: float(len(each.corners)) for number, each in observed.items()}
    before_px = residual_px(observed, measured, board, camera)
    open_px = before_px * float(np.sqrt(3.0 / np.mean(list(weights.values()))))
    limit_px = float(np.hypot(before_px, open_px + extra_px))
    middle_m = board.corners_m.mean(axis=0)
    steady = steady_poses(measured, weights, middle_m, _WEAKEST)
    strength = _WEAKEST * _STEP
    while strength < _STRONGEST:
        stronger = steady_poses(measured, weights, middle_m, strength)
        if residual_px(observed, stronger, board, camera) > limit_px:
            break
        steady, strength = stronger, strength * _STEP
    return steady


def residual_px(observed: Mapping[int, Observation], poses: Mapping[int, Pose], board: FlatPrint, camera: Camera) -> float:
    """Return the RMS distance of all observed corners from where the poses put them."""
    squares = []
    for number, each in observed.items():
        seen_px, _ = replace(camera, camera_from_world=poses[number]).project(board.corners_m[each.corners.ids])
        squares.append(np.sum((seen_px - each.corners.xy_px) ** 2, axis=1))
    return float(np.sqrt(np.mean(np.concatenate(squares))))
