"""`mrbokeh tilt-shift`: blur grows evenly beside a line, a map may take its place, and the picture is the exact blur of its diameters."""

from pathlib import Path

import cv2
import numpy as np
import pytest

from mrbokeh.commands.tilt_shift import blur_beside
from mrbokeh.images.image_io import read_image, write_image
from mrbokeh.optics.lens import Lens
from mrbokeh.optics.lens_file import write_lens
from mrbokeh.system.errors import InputError
from tests.support.command_line import mrbokeh

WIDTH, HEIGHT, LARGEST_PX = 96, 64, 12.0


def test_blur_grows_evenly_beside_the_line_and_changes_sign_on_it() -> None:
    level = blur_beside(((0.0, 16.0), (10.0, 16.0)), (WIDTH, HEIGHT), LARGEST_PX)
    assert level.shape == (HEIGHT, WIDTH) and np.ptp(level, axis=1).max() < 1e-6, "rows are even"
    rows = np.arange(HEIGHT) + 0.5
    np.testing.assert_allclose(level[:, 0], (16.0 - rows) * LARGEST_PX / (HEIGHT - 0.5 - 16.0), atol=1e-5)
    oblique = blur_beside(((WIDTH, 0.0), (0.0, HEIGHT)), (WIDTH, HEIGHT), LARGEST_PX)
    np.testing.assert_array_equal(oblique, blur_beside(((0.0, HEIGHT), (WIDTH, 0.0)), (WIDTH, HEIGHT), LARGEST_PX))
    assert oblique[0, 0] == pytest.approx(LARGEST_PX, abs=0.01) == -oblique[-1, -1]
    with pytest.raises(InputError, match="two that lie apart"):
        blur_beside(((3.0, 4.0), (3.0, 4.0)), (WIDTH, HEIGHT), LARGEST_PX)


@pytest.fixture
def photo(tmp_path: Path) -> Path:
    """Noise whose blur is seen everywhere."""
    write_image(tmp_path / "photo.exr", np.random.default_rng(1).random((HEIGHT, WIDTH, 3)).astype(np.float32), half=False)
    return tmp_path / "photo.exr"


def test_a_line_stays_sharp_and_the_rest_has_the_area_of_its_circle(photo: Path, tmp_path: Path) -> None:
    """White noise that is averaged over a disc of d px keeps 1 / (pi d^2 / 4) of its variance."""
    out = tmp_path / "out.exr"
    done = mrbokeh("tilt-shift", photo, "--along", f"0,{HEIGHT - 1}:{WIDTH},{HEIGHT - 1}", "--diameter", "12", "--out", out)
    assert done.returncode == 0 and "blurred by up to 12 px" in done.stdout, done.stderr
    sharp, blurred = read_image(photo), read_image(out)
    np.testing.assert_allclose(blurred[-2:], sharp[-2:], atol=0.1)
    row = 8
    diameter_px = 12.0 * (HEIGHT - 1.5 - row) / (HEIGHT - 1.5)
    kept = blurred[row - 4 : row + 5].var() / sharp.var()
    assert kept == pytest.approx(4.0 / (np.pi * diameter_px**2), rel=0.35)
    again = mrbokeh("tilt-shift", photo, "--out", out)
    assert again.returncode == 2 and "--overwrite" in again.stderr


def test_a_map_says_where_and_a_lens_how(photo: Path, tmp_path: Path) -> None:
    drawn = np.zeros((HEIGHT, WIDTH), np.uint8)
    drawn[:, WIDTH // 2 :] = 255
    cv2.imwrite(str(tmp_path / "map.png"), drawn)
    write_lens(tmp_path / "lens.json", Lens(50.0, 2.0, 1.0, 36.0))
    words = ("tilt-shift", photo, "--map", tmp_path / "map.png", "--lens", tmp_path / "lens.json", "--diameter", "8")
    assert mrbokeh(*words, "--out", tmp_path / "out.exr").returncode == 0
    write_image(tmp_path / "bright.exr", np.repeat(drawn[..., None].astype(np.float32), 3, axis=2))
    again = mrbokeh(*words[:3], tmp_path / "bright.exr", *words[4:], "--out", tmp_path / "same.exr")
    same = np.array_equal(read_image(tmp_path / "same.exr"), read_image(tmp_path / "out.exr"))
    assert again.returncode == 0 and same, "white is 1 or more"
    sharp, blurred = read_image(photo), read_image(tmp_path / "out.exr")
    np.testing.assert_allclose(blurred[:, : WIDTH // 2 - 6], sharp[:, : WIDTH // 2 - 6], atol=1e-3)
    assert blurred[:, WIDTH // 2 + 6 :].var() < 0.05 * sharp.var()


@pytest.mark.parametrize(
    ("words", "why"),
    [
        (("--along", "1,2"), "two pixels X,Y with a colon"),
        (("--along", "1,2:3,4", "--map", "photo.exr"), "give one of them"),
        (("--diameter", "900"), "up to half the width of 96 px"),
        (("--map", "small.png"), "has 4x4 px"),
        (("--out", "out.txt"), "--out"),
    ],
)
def test_what_cannot_be_meant_is_refused(photo: Path, tmp_path: Path, words: tuple[str, ...], why: str) -> None:
    cv2.imwrite(str(tmp_path / "small.png"), np.zeros((4, 4), np.uint8))
    named = [str(tmp_path / each) if each.endswith((".exr", ".png")) else each for each in words]
    out = () if "--out" in words else ("--out", tmp_path / "out.png")
    done = mrbokeh("tilt-shift", photo, *named, *out)
    assert done.returncode == 2 and why in done.stderr and len(done.stderr.strip().splitlines()) == 1, done.stderr
