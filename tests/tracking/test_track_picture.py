"""The axes of a track's world, drawn where the camera sees them."""

from fractions import Fraction
from pathlib import Path

import cv2
import numpy as np
import typer
from typer.testing import CliRunner

from datasets_scripts.track_picture import axes_of, main, with_axes
from mrbokeh.optics.camera import Camera
from mrbokeh.tracking.camera_track.formats import write_track
from mrbokeh.tracking.camera_track.track import fixed_track
from mrbokeh.video.writer import VideoWriter

CAMERA = Camera(160, 112, (100.0, 100.0), (80.5, 56.5))


def drawn_axes(at_z_m: float, up: str) -> np.ndarray:
    return with_axes(np.zeros((112, 160, 3), np.uint8), CAMERA, axes_of(up, 0.4), np.array([0.0, 0.0, at_z_m]))


def test_axes_are_where_the_camera_sees_them() -> None:
    """0.4 m to the right at 1 m is 40 px at a focal length of 100 px, and so is 0.4 m down; z runs towards the middle of the picture."""
    drawn = drawn_axes(1.0, "-z")
    assert drawn[56, 105].tolist() == [255, 40, 40] and drawn[85, 80].tolist() == [40, 220, 40]
    assert drawn[56, 80].tolist() == [60, 110, 255]
    assert drawn[56, 119:122].max() == 255 and not drawn[56, 123:].any(), "the side of the square, at 120.5"
    assert not drawn[:14].any() and drawn[16, 60:100, 0].min() > 100, "its upper side, at 16.5"


def test_up_is_blue() -> None:
    """-y is up in the picture of a level camera."""
    assert drawn_axes(2.0, "-y")[45, 80].tolist() == [60, 110, 255]
    assert not (drawn_axes(2.0, "+y")[:50, 80] == [60, 110, 255]).all(1).any()


def test_lines_behind_the_camera_are_left_out() -> None:
    assert not drawn_axes(-1.0, "-z").any()


def test_the_command_shows_three_frames(tmp_path: Path) -> None:
    with VideoWriter(tmp_path / "clip.mkv", 160, 112, Fraction(25)) as video:
        for number in range(5):
            video.write(np.full((112, 160, 3), 0.2, np.float32), number / 25.0)
    write_track(tmp_path / "track.json", fixed_track(CAMERA))
    app = typer.Typer()
    app.command()(main)
    words = [str(tmp_path / name) for name in ("clip.mkv", "track.json", "track.png")]
    done = CliRunner().invoke(app, [*words, "--at", "0,0,1", "--size-m", "0.4"])
    assert done.exit_code == 0, done.output
    sheet = cv2.imread(words[2])[..., ::-1]
    assert sheet.shape == (112, 480, 3)
    assert all(sheet[56, 105 + 160 * number].tolist() == [255, 40, 40] for number in range(3))
    assert np.abs(sheet[5, 5].astype(int) - 124).max() <= 2, "linear 0.2 is 124 of 255 in sRGB"
    refused = CliRunner().invoke(app, [*words, "--at", "0,0", "--overwrite"])
    assert refused.exit_code == 2 and "expected --at X,Y,Z" in refused.output
