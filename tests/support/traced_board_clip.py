"""A traced, hand-held clip of a board of two scales with exact poses: what tracking is measured against."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cache

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from datasets_scripts.charuco_clip import BoardClip, HandHeld, Sheet
from mrbokeh.images.color import display_rgb8
from mrbokeh.optics.camera import Camera
from mrbokeh.optics.lens import MM_PER_M, Lens
from mrbokeh.tracking.charuco.board import CharucoBoard, CharucoGrid, black_rectangles_mm
from mrbokeh.tracking.charuco.detector import Corners, Grey
from viewfinder.frames import CameraFrame, Pose

BOARD = CharucoBoard((CharucoGrid((4, 3), 46.0, 34.0), CharucoGrid((9, 5), 20.0, 15.0, (0.0, 143.0), 6)))
"""Fits on A4: 184 x 243 mm."""

LENS = Lens(22.0, 8.0, 0.6, 24.0)
MOTION = HandHeld((0.092, 0.12, 0.0))
ABOVE_M = np.array([[x, y, -height] for x in (0.02, 0.09, 0.16) for y in (0.03, 0.12, 0.21) for height in (0.05, 0.10, 0.15)])
"""Where an object may stand: 5 to 15 cm above the board."""


@dataclass(frozen=True)
class PoseError:
    """turn_deg: angle between the poses. place_mm: between the centres of projection. object_px: the worst of ABOVE_M."""

    turn_deg: float
    place_mm: float
    object_px: float


def pose_error(pose: Pose, true: Camera) -> PoseError:
    turn = pose[:3, :3] @ true.camera_from_world[:3, :3].T
    angle = np.arcsin(np.clip(np.linalg.norm(turn - turn.T) / np.sqrt(8.0), 0.0, 1.0))
    found = replace(true, camera_from_world=pose)
    place = np.linalg.norm(found.world_from_camera[:3, 3] - true.world_from_camera[:3, 3])
    off_px = np.linalg.norm(found.project(ABOVE_M)[0] - true.project(ABOVE_M)[0], axis=1)
    return PoseError(float(np.rad2deg(angle)), float(place) * MM_PER_M, float(off_px.max()))


def clip_of(width_px: int, height_px: int, frames: int, lens: Lens = LENS, motion: HandHeld = MOTION) -> BoardClip:
    return BoardClip(Sheet(black_rectangles_mm(BOARD)), motion, lens, width_px, height_px, frames, noise=0.01, samples=8)


def tilted_views(
    board: CharucoBoard, tilts_deg: Sequence[float] | np.ndarray, distance_m: float, k1: float = 0.0, sigma_px: float = 0.1
) -> list[Corners]:
    """Boards seen by OpenCV's own formula with 600 px and the middle at (310, 185), tilted about x and, every second one, about y."""
    rng, matrix = np.random.default_rng(2), np.array([[600.0, 0, 309.5], [0, 600.0, 184.5], [0, 0, 1]])
    middle = board.corners_m.mean(axis=0)
    seen = []
    for index, tilt in enumerate(tilts_deg):
        turn = Rotation.from_euler("yx"[index % 2], tilt, degrees=True)
        shift = np.array([0.02 * (index % 3 - 1), 0.01, distance_m]) - turn.apply(middle)
        xy = cv2.projectPoints(board.corners_m, turn.as_rotvec(), shift, matrix, np.array([k1, 0.0, 0.0, 0.0]))[0].reshape(-1, 2)
        seen.append(Corners(np.arange(len(xy)), xy.astype(np.float64) + 0.5 + rng.normal(0.0, sigma_px, xy.shape)))
    return seen


def grey_of(frame: CameraFrame) -> Grey:
    return cv2.cvtColor(frame.bgr, cv2.COLOR_BGR2GRAY)


def camera_frames(clip: BoardClip) -> Iterator[tuple[CameraFrame, Camera]]:
    """(the frame as a camera gives it, its true camera)."""
    for number, rgb in enumerate(clip.pictures()):
        yield CameraFrame(np.ascontiguousarray(display_rgb8(rgb)[..., ::-1]), number / clip.fps, number), clip.camera(number)


@cache
def small_clip() -> tuple[tuple[CameraFrame, Camera], ...]:
    """8 frames of 640x360, sharp where the board is."""
    return tuple(camera_frames(clip_of(640, 360, 8)))
