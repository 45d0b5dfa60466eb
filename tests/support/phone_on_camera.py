"""A camera and a phone that is fixed to it, looking at one board from several sides: traced pictures with exact poses."""

from dataclasses import replace
from functools import cache
from pathlib import Path

import cv2
import numpy as np

from datasets_scripts.charuco_clip import pack_table, trace_sheet
from mrbokeh.images.color import display_rgb8
from mrbokeh.optics.camera import Camera, camera_to_json
from mrbokeh.optics.lens import Lens
from mrbokeh.optics.lens_file import write_lens
from mrbokeh.system.atomic_files import write_json
from mrbokeh.tracking.charuco.board import write_board
from mrbokeh.tracking.world_axes import inverted, rigid
from tests.support.traced_board_clip import BOARD, clip_of
from viewfinder.frames import Pose
from viewfinder.tracking.phone_rig import angle_deg, rigid_of

CAMERA_FROM_PHONE = rigid_of(np.array([0.05, -0.02, 0.03, -0.03, -0.06, 0.02]))
"""The phone 6 cm above the lens, 3 cm to its left, a little askew."""

LENS = Lens(22.0, 16.0, 0.6, 24.0)
_CAMERA = Camera(480, 270, (LENS.focal_px(480),) * 2, (240.0, 135.0))
PHONE = Camera(480, 270, (390.0, 390.0), (240.0, 135.0))
VIEWS = 7


@cache
def view(number: int) -> Pose:
    """camera_from_world of one of VIEWS: from 0.55 to 0.65 m, tilted to all sides."""
    around = 2 * np.pi * number / VIEWS
    turn = cv2.Rodrigues(np.array([0.35 * np.cos(around), 0.35 * np.sin(around), 0.15 * np.sin(2 * around)]))[0]
    middle = np.append(BOARD.size_mm, 0.0) / 2000.0
    return rigid(turn, np.array([0.01, 0.02, 0.6 + 0.05 * np.cos(3 * around)]) - turn @ middle)


def camera_at(number: int) -> Camera:
    return replace(_CAMERA, camera_from_world=view(number))


def phone_at(number: int, camera_from_phone: Pose = CAMERA_FROM_PHONE) -> Camera:
    return replace(PHONE, camera_from_world=inverted(camera_from_phone) @ view(number))


def picture(camera: Camera) -> np.ndarray:
    """8-bit display codes, blue first; everything is sharp."""
    table = pack_table(clip_of(64, 48, 1).sheet)
    return np.ascontiguousarray(display_rgb8(trace_sheet(table, camera, None, 8))[..., ::-1])


def write_files(folder: Path) -> None:
    """board.json, lens.json (of the camera), phone.json (intrinsics)."""
    write_board(folder / "board.json", BOARD)
    write_lens(folder / "lens.json", LENS)
    write_json(folder / "phone.json", camera_to_json(PHONE))


def rig_error(camera_from_phone: Pose) -> tuple[float, float]:
    """(degrees, mm) by which it misses the truth."""
    error = camera_from_phone @ inverted(CAMERA_FROM_PHONE)
    return angle_deg(error), 1000 * float(np.linalg.norm(error[:3, 3]))
