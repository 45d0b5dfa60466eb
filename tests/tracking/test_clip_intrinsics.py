"""A camera that was held upright: its intrinsics are stated for the level sensor, its clip is turned by metadata."""

from pathlib import Path

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from mrbokeh.optics.camera import Camera
from mrbokeh.system.errors import InputError
from mrbokeh.tracking.camera_track.board_track import Intrinsics, intrinsics_of_clip
from mrbokeh.tracking.camera_track.track import DISTORTION_NAMES

LEVEL = Intrinsics(Camera(640, 360, (600.0, 620.0), (330.0, 170.0)), {"k1": -0.1, "p1": 0.01, "p2": -0.02, "k3": 0.03})
POINTS_M = np.array([[0.1, -0.05, 1.0], [-0.2, 0.1, 1.0], [0.0, 0.15, 1.0], [0.25, 0.12, 1.0]])
CLIP = Path("clip.mov")


def seen_px(intrinsics: Intrinsics, points_m: np.ndarray) -> np.ndarray:
    """By OpenCV's model of a lens."""
    (fx, fy), (cx, cy) = intrinsics.camera.focal_px, intrinsics.camera.principal_px
    coefficients = np.array([(intrinsics.distortion or {}).get(name, 0.0) for name in DISTORTION_NAMES])
    matrix = np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])
    return cv2.projectPoints(points_m, np.zeros(3), np.zeros(3), matrix, coefficients)[0].reshape(-1, 2)


def turned_px(xy_px: np.ndarray, size_px: tuple[int, int], quarter_turns: int) -> np.ndarray:
    """Where numpy's rot90 brings places of a picture."""
    for _ in range(quarter_turns):
        xy_px, size_px = np.stack([xy_px[:, 1], size_px[0] - xy_px[:, 0]], axis=1), size_px[::-1]
    return xy_px


@pytest.mark.parametrize("quarter_turns", [0, 1, 2, 3])
def test_what_a_turned_camera_sees_is_what_the_level_one_saw_turned(quarter_turns: int) -> None:
    """y points down: pictures turned counter-clockwise are those of a camera that was turned clockwise."""
    size_px = (640, 360) if quarter_turns % 2 == 0 else (360, 640)
    found = intrinsics_of_clip(LEVEL, size_px, quarter_turns, CLIP)
    assert (found.camera.width_px, found.camera.height_px) == size_px
    turn = Rotation.from_euler("z", -90.0 * quarter_turns, degrees=True)
    if quarter_turns == 2:
        # Of the same shape: nobody can tell, and no lens is known that well.
        assert found.camera.principal_px == LEVEL.camera.principal_px
        found = LEVEL.turned(2)
    np.testing.assert_allclose(
        seen_px(found, turn.apply(POINTS_M)), turned_px(seen_px(LEVEL, POINTS_M), (640, 360), quarter_turns), atol=1e-6
    )


def test_the_place_of_a_pixel_is_that_of_rot90() -> None:
    picture = np.zeros((360, 640))
    picture[20, 600] = 1.0
    for turns in range(4):
        (row,), (column,) = np.nonzero(np.rot90(picture, turns))
        np.testing.assert_array_equal(turned_px(np.array([[600.5, 20.5]]), (640, 360), turns), [[column + 0.5, row + 0.5]])


def test_another_size_of_the_same_shape_is_taken() -> None:
    found = intrinsics_of_clip(LEVEL, (180, 320), 3, CLIP).camera
    assert found.focal_px == (310.0, 300.0)


@pytest.mark.parametrize(("size_px", "turns"), [((640, 480), 0), ((360, 640), 0), ((480, 640), 1)])
def test_pictures_of_another_shape_are_refused(size_px: tuple[int, int], turns: int) -> None:
    with pytest.raises(InputError, match=f"clip.mov .{size_px[0]}x{size_px[1]}., got those of 640x360"):
        intrinsics_of_clip(LEVEL, size_px, turns, CLIP)
