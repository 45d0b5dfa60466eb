"""A camera on a tripod: its pose from a file."""

from pathlib import Path

import numpy as np
import pytest

from mrbokeh.optics.camera import Camera, camera_to_json
from mrbokeh.system.atomic_files import write_json
from mrbokeh.system.errors import InputError
from viewfinder.frames import CameraFrame
from viewfinder.tracking.tracker import read_fixed_pose

POSE = np.array([[1.0, 0.0, 0.0, 0.1], [0.0, 0.8, -0.6, 0.2], [0.0, 0.6, 0.8, 0.9], [0.0, 0.0, 0.0, 1.0]])
CAMERA = Camera(640, 360, (600.0, 600.0), (320.0, 180.0), POSE)


def test_the_pose_of_the_file_is_that_of_every_frame(tmp_path: Path) -> None:
    write_json(tmp_path / "camera.json", camera_to_json(CAMERA))
    tracker = read_fixed_pose(tmp_path / "camera.json")
    for number in range(2):
        tracked = tracker.track(CameraFrame(np.zeros((9, 16, 3), np.uint8), 0.1 * number, number), CAMERA)
        assert tracked.captured_s == 0.1 * number and tracked.quality == 1.0
        np.testing.assert_array_equal(tracked.camera_from_world, POSE)
    assert tracker.camera.focal_px == (600.0, 600.0)


def test_files_that_are_no_camera_are_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no such file"):
        read_fixed_pose(tmp_path / "none.json")
    write_json(tmp_path / "list.json", [1, 2])
    with pytest.raises(InputError, match="expected width_px"):
        read_fixed_pose(tmp_path / "list.json")
    skewed = POSE.copy()
    skewed[0, 0] = 2.0
    write_json(tmp_path / "skewed.json", camera_to_json(Camera(640, 360, (600.0, 600.0), (320.0, 180.0), skewed)))
    with pytest.raises(InputError, match="rigid"):
        read_fixed_pose(tmp_path / "skewed.json")
