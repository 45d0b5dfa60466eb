"""Apple's maker notes: how a phone was held, by its accelerometer, and the range of its focus."""

from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from mrbokeh.images.apple_notes import AppleNotes, apple_notes, held_by_phone
from tests.support.apple_note import apple_note
from tests.support.command_line import mrbokeh
from tests.support.made_studio import CAKE, write_floor

DOWN_RAD, ROLL_RAD = np.radians(20.0), np.radians(5.0)


def gravity_of(down: np.ndarray, held: str) -> tuple[float, float, float]:
    """The phone's reading for what is down in camera axes (right, down, forward), by which side of it is up in the picture.

    Upright its right is the picture's; level, as cameras are held, the top lies to the left, so that its right is up.
    """
    right, below, ahead = down
    across = {"top": (right, -below), "bottom": (-right, below), "right": (-below, -right), "left": (below, right)}[held]
    return (*across, -ahead)


def photo(path: Path, gravity: tuple[float, float, float], lens: str = "iPhone 13 Pro back camera 5.7mm f/1.5") -> Path:
    exif = Image.Exif()
    exif.get_ifd(0x8769).update({0x927C: apple_note({8: [(round(1e6 * each), 1_000_000) for each in gravity]}), 0xA434: lens})
    with Image.open(write_floor(path.with_suffix(".png"))) as floor:
        floor.convert("RGB").save(path, exif=exif.tobytes())
    return path


@pytest.mark.parametrize("held", ["top", "bottom", "left", "right"])
@pytest.mark.parametrize("down_rad", [DOWN_RAD, -DOWN_RAD])
def test_the_camera_is_held_as_the_phone_tells(tmp_path: Path, held: str, down_rad: float) -> None:
    """Whichever side of the phone was up, the picture is upright; looking down, what is down lies ahead too."""
    down = np.array([np.sin(ROLL_RAD) * np.cos(down_rad), np.cos(ROLL_RAD) * np.cos(down_rad), np.sin(down_rad)])
    turn = held_by_phone(photo(tmp_path / "a.jpg", gravity_of(down, held)))
    assert turn is not None
    np.testing.assert_allclose(turn @ turn.T, np.eye(3), atol=1e-6)
    np.testing.assert_allclose(turn[1], down, atol=1e-5)
    assert np.linalg.det(turn) > 0.0 and abs(turn[0, 2]) < 1e-6, "it looks no way aside"


def test_straight_down_has_no_roll(tmp_path: Path) -> None:
    turn = held_by_phone(photo(tmp_path / "a.jpg", (0.02, -0.05, -1.0)))
    assert turn is not None and turn[1, 2] > 0.99 and turn[1, 0] == 0.0


def test_what_a_note_does_not_tell_is_unknown(tmp_path: Path) -> None:
    whole = apple_note({8: [(-1, 1), (0, 1), (0, 1)], 12: [(16, 10), (8, 10)]})
    assert apple_notes(whole) == AppleNotes((-1.0, 0.0, 0.0), (0.8, 1.6))
    assert apple_notes(whole[:40]) == apple_notes(b"Nikon") == apple_notes(b"") == AppleNotes()
    assert apple_notes(apple_note({8: [(-1, 0), (0, 1), (0, 1)], 12: [(0, 1), (5, 1)]})) == AppleNotes()
    assert held_by_phone(photo(tmp_path / "moved.jpg", (0.6, -0.9, 0.9))) is None, "1.4 g: it was moved"
    assert held_by_phone(photo(tmp_path / "self.jpg", (0.0, -1.0, 0.0), "iPhone 13 Pro front camera 2.71mm f/2.2")) is None
    assert held_by_phone(write_floor(tmp_path / "plain.png")) is None


def test_composite_takes_it_and_says_so(tmp_path: Path) -> None:
    down = np.array([0.0, np.cos(DOWN_RAD), np.sin(DOWN_RAD)])
    path = photo(tmp_path / "a.jpg", gravity_of(down, "right"))
    words = ("composite", path, "--object", CAKE, "--at-pixel", "120,140", "--height", "60px", "--preview", "--out")
    done = mrbokeh(*words, tmp_path / "out.png")
    assert done.returncode == 0 and "by the phone's own level the camera looks down by 20 degrees" in done.stdout, done.stdout
    other = mrbokeh(*words, tmp_path / "told.png", "--pitch", "5")
    assert other.returncode == 0 and "own level" not in other.stdout
    assert (tmp_path / "out.png").read_bytes() != (tmp_path / "told.png").read_bytes()
