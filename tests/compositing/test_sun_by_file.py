"""The sun of a photograph whose file tells where it stood: taken if it shines by the exposure, said, and replaced by options."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import mrbokeh
from mrbokeh.compositing.open_plate import open_plate
from mrbokeh.compositing.plate_light import is_sunlit
from mrbokeh.demo.plan import DATA
from mrbokeh.images.image_io import read_image
from mrbokeh.solving.sun_of_photograph import SunOfPhotograph
from tests.support.command_line import mrbokeh as run
from tests.support.sunny_photographs import EXPOSED, GPS, TAKEN, write_sunny

CAKE = DATA / "objects" / "cakeBirthday.glb"
FOOT_PX = (150, 150)
STANDING = ("--object", CAKE, "--at-pixel", "150,150", "--height", "60px", "--pitch", 15, "--grain", "off", "--match-black", "off")


def composited(photo: Path, out: Path, *options: object) -> tuple[np.ndarray, str]:
    done = run("composite", photo, *STANDING, *options, "--out", out, "--overwrite")
    assert done.returncode == 0, done.stderr
    return read_image(out), done.stdout


def test_the_shadow_falls_away_from_the_sun_of_the_file(tmp_path: Path) -> None:
    """The sun is 90 degrees to the right, 40 high; the picture is that of the option which is said."""
    photo = write_sunny(tmp_path / "photo.jpg", GPS, TAKEN | EXPOSED)
    picture, told = composited(photo, tmp_path / "out.png")
    assert "time, place and compass in the file it stood at --sun 90,40" in told
    np.testing.assert_array_equal(picture, composited(photo, tmp_path / "told.png", "--sun", "90,40")[0])
    light = picture[FOOT_PX[1] - 6 : FOOT_PX[1] + 6].mean(axis=(0, 2))
    left, right = light[FOOT_PX[0] - 80 : FOOT_PX[0] - 40], light[FOOT_PX[0] + 40 : FOOT_PX[0] + 80]
    assert left.min() < 0.5 * right.min()


def test_options_replace_the_sun_of_the_file(tmp_path: Path) -> None:
    photo = write_sunny(tmp_path / "photo.jpg", GPS, TAKEN | EXPOSED)
    for options in (("--sun", "-30,50"), ("--sun-by", "200,60:200,160:240,170"), ("--plain",)):
        standing = ("--at", "0,0.5,2") if options == ("--plain",) else ()
        words = [each for each in STANDING if not (standing and each in ("--at-pixel", "150,150"))]
        words += [*standing, *options, "--focus", 3, "--shadow", 0]
        done = run("composite", photo, *words, "--out", tmp_path / "out.png", "--overwrite")
        assert done.returncode == 0, done.stderr
        assert "in the file it stood" not in done.stdout


@pytest.mark.parametrize(
    ("gps", "exif", "said"),
    [
        ({tag: GPS[tag] for tag in GPS if tag not in (16, 17)}, EXPOSED, "it stood 40 degrees high; no compass tells on which side"),
        (GPS | {16: "M"}, EXPOSED, "compass, turned from magnetic to true north, in the file it stood at --sun 84,40"),
        (GPS, EXPOSED | {0x829A: 0.5}, "else --exposure, --sun 90,40, where the sun would be by the file"),
        (GPS | {7: (6.0, 30.0, 0.0)}, {0x9003: "2003:10:16 23:30:00"}, "else --exposure, --sun RIGHT,ABOVE"),
        ({}, EXPOSED, "a soft light from behind at the left is taken (--sun RIGHT,ABOVE"),
    ],
    ids=["no compass", "magnetic north", "a room", "night", "no place"],
)
def test_what_is_taken_is_said(tmp_path: Path, gps: dict[int, Any], exif: dict[int, Any], said: str) -> None:
    _, told = composited(write_sunny(tmp_path / "photo.jpg", gps, TAKEN | EXPOSED | exif), tmp_path / "out.png", "--preview", "--shadow", 0)
    assert said in told


def test_a_low_sun_shines_in_less_light(tmp_path: Path) -> None:
    """A clear day gives 42 klx with the sun 24 degrees high (RP-21), an overcast one 9; here a white surface has 30 by the exposure."""
    plate = open_plate(write_sunny(tmp_path / "photo.jpg", {}, TAKEN | EXPOSED | {0x829A: 1 / 35}), focus_m=3.0)
    assert not is_sunlit(plate, FOOT_PX)
    assert is_sunlit(replace(plate, sun=SunOfPhotograph(24.0)), FOOT_PX)
    assert not is_sunlit(replace(plate, sun=SunOfPhotograph(60.0)), FOOT_PX)
    bright = replace(plate, white_lux=100_000.0)
    assert is_sunlit(bright, FOOT_PX)
    assert not is_sunlit(replace(bright, sun=SunOfPhotograph(2.0)), FOOT_PX), "a sun on the horizon"


def test_pythons_composite_has_the_same_sun(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    photo = write_sunny(tmp_path / "photo.jpg", GPS, TAKEN | EXPOSED)
    depth_m = np.full((200, 300), 2.0, np.float32)
    mrbokeh.composite(photo, CAKE, depth_m=depth_m, focus=2.0, at_pixel=FOOT_PX, height="60px")
    assert "--sun 90,40" in capsys.readouterr().out
