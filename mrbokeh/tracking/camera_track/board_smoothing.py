"""How strongly the poses of a board may be smoothed: as far as the scatter of its corners leaves them open, and no farther.

Six parameters fitted to n corners that are each off by r px are themselves off by r sqrt(6 / 2n) px in the picture (RMS). The strongest
splines are taken whose poses move the picture of the board by no more: noise goes, and the trembling of a hand, which the plate
shows too, stays.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from mrbokeh.optics.camera import Camera
from mrbokeh.tracking.camera_track.steady_poses import Pose, steady_poses
from mrbokeh.tracking.charuco.board import CharucoBoard
from mrbokeh.tracking.charuco.detector import Corners

_WEAKEST, _STRONGEST, _STEP = 1e-4, 1e7, 2.0


@dataclass(frozen=True)
class Observation:
    """corners: those that the pose explains."""

    pose: Pose
    corners: Corners


def steadied(observed: Mapping[int, Observation], board: CharucoBoard, camera: Camera, extra_px: float = 0.0) -> dict[int, Pose]:
    """camera_from_world of all frames from the first to the last that was observed. extra_px: RMS by which they may move further."""
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


def residual_px(observed: Mapping[int, Observation], poses: Mapping[int, Pose], board: CharucoBoard, camera: Camera) -> float:
    """RMS distance of all observed corners from where the poses put them."""
    squares = []
    for number, each in observed.items():
        seen_px, _ = replace(camera, camera_from_world=poses[number]).project(board.corners_m[each.corners.ids])
        squares.append(np.sum((seen_px - each.corners.xy_px) ** 2, axis=1))
    return float(np.sqrt(np.mean(np.concatenate(squares))))
