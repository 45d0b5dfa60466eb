"""The lens of a lens file for clips that are shown turned: opening, tilt and sensor lie as the camera was held, as for photographs."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import tifffile
from PIL import Image

from mrbokeh.commands.video import app
from mrbokeh.images.image_io import read_image, read_layer, write_layer
from mrbokeh.images.layer import Layer
from mrbokeh.optics.aperture import Aperture
from mrbokeh.optics.lens import Lens
from mrbokeh.optics.lens_file import write_lens
from mrbokeh.video.picture_source import open_source
from tests.support.command_line import printed_by
from tests.support.refusals import refused
from tests.support.video_files import filmed, turned_clip

WIDTH, HEIGHT = 96, 64
# A heart has no symmetry but left and right, a tilt none. 25 mm of aperture, 51.3 mm to the sensor and 16 px per mm: 10 px at 1 m.
LENS = Lens(50.0, 2.0, 2.0, 6.0, Aperture.heart(), tilt_rad=(0.02, 0.01))
ORIENTATION = {0: 1, 1: 8, 2: 3, 3: 6}
"""EXIF's number by quarter turns counter-clockwise that bring the stored picture upright."""


def light(quarters: int) -> Layer:
    """A few pixels off the middle at 1 m, as an upright renderer sees them."""
    alpha = np.zeros((HEIGHT, WIDTH), np.float32)
    alpha[24:27, 50:55] = 1.0
    alpha = np.ascontiguousarray(np.rot90(alpha, quarters))
    return Layer(np.repeat(alpha[..., None], 3, axis=2), alpha, np.where(alpha > 0, np.float32(1.0), np.float32(np.inf)))


def blurred(folder: Path, clip: Path, quarters: int, lens: Lens, *more: str) -> Layer:
    """What of the light arrives in frame 0."""
    write_layer(folder / "layer.exr", light(quarters), half=False)
    write_lens(folder / "lens.json", lens)
    words = [clip, *more, "--layer", folder / "layer.exr", "--lens", folder / "lens.json", "--out", folder / "out.%d.exr"]
    options = ["--virtual-only", "--frames", "0", "--workers", "1", "--renderer", "scatter", "--overwrite"]
    printed_by(app, *words, *options)
    return read_layer(folder / "out.0.exr")


def grey_video(folder: Path) -> Path:
    return filmed(folder / "level.mov", [np.full((HEIGHT, WIDTH, 3), 0.2, np.float32)])


def photographs(folder: Path, suffix: str, quarters: int) -> Path:
    """A numbered photograph whose pixels are all different, stored level."""
    pixels = np.arange(HEIGHT * WIDTH * 3).astype(np.uint32).reshape(HEIGHT, WIDTH, 3) * 37 % 251
    path = folder / f"taken_{quarters}.0.{suffix}"
    if suffix == "tif":
        tifffile.imwrite(path, (257 * pixels).astype(np.uint16), photometric="rgb", extratags=[(274, 3, 1, ORIENTATION[quarters], True)])
    else:
        exif = Image.Exif()
        exif[0x0112] = ORIENTATION[quarters]
        Image.fromarray(pixels.astype(np.uint8)).save(path, exif=exif, **({"quality": 100} if suffix == "jpg" else {}))
    return path.with_name(f"taken_{quarters}.%d.{suffix}")


def require_turned(turned: Layer, level: Layer, quarters: int) -> None:
    """Half of EXR has 11 bits."""
    assert level.alpha.max() > 0.05
    np.testing.assert_allclose(turned.alpha, np.rot90(level.alpha, quarters), atol=2**-11)
    np.testing.assert_allclose(turned.rgb, np.rot90(level.rgb, quarters), atol=2**-11)


@pytest.mark.parametrize("quarters", [1, 2, 3])
def test_a_turned_video_has_the_blur_of_the_level_one(tmp_path: Path, quarters: int, caplog: pytest.LogCaptureFixture) -> None:
    """The same camera, the same place on its sensor: the heart lies as the picture does, and is as many pixels large."""
    clip = grey_video(tmp_path)
    level = blurred(tmp_path, clip, 0, LENS)
    assert not caplog.text
    turned = blurred(tmp_path, turned_clip(clip, tmp_path / "turned.mov", 90 * quarters), quarters, LENS)
    require_turned(turned, level, quarters)
    said = [line for line in caplog.messages if "turned.mov was taken with the camera held upright: 4 mm of the sensor are taken" in line]
    assert len(said) == (1 if quarters % 2 else 0)


@pytest.mark.parametrize(("suffix", "quarters"), [("jpg", 2), ("png", 3), ("tif", 3)])
def test_turned_photographs_have_the_blur_of_the_level_ones(tmp_path: Path, suffix: str, quarters: int) -> None:
    """They come upright as for `mrbokeh composite`, and the lens with them."""
    level, turned = (photographs(tmp_path, suffix, each) for each in (0, quarters))
    upright = next(open_source(turned, "25").frames(0, 1)).rgb
    np.testing.assert_array_equal(upright, np.rot90(next(open_source(level, "25").frames(0, 1)).rgb, quarters))
    found = blurred(tmp_path, turned, quarters, LENS, "--rate", "25")
    require_turned(found, blurred(tmp_path, level, 0, LENS, "--rate", "25"), quarters)


def test_a_lens_described_upright_is_left_as_it_is(tmp_path: Path) -> None:
    """4 mm by 6 mm: the lens of the turned clip as it is seen upright."""
    clip = turned_clip(grey_video(tmp_path), tmp_path / "turned.mov", 90)
    tall = replace(LENS, sensor_width_mm=4.0, sensor_height_mm=6.0)
    still = blurred(tmp_path, clip, 1, tall)
    upright = filmed(tmp_path / "upright.mov", [np.full((WIDTH, HEIGHT, 3), 0.2, np.float32)])
    np.testing.assert_allclose(still.alpha, blurred(tmp_path, upright, 1, tall).alpha, atol=2**-11)


def test_photographs_that_turn_amid_the_sequence_are_refused(tmp_path: Path) -> None:
    for number, quarters in enumerate((0, 2)):
        photographs(tmp_path, "png", quarters).with_name(f"taken_{quarters}.0.png").rename(tmp_path / f"in.{number}.png")
    source = open_source(tmp_path / "in.%d.png", "25")
    refused(r"EXIF says orientation 3 of .*in\.1\.png, but 1 of .*in\.0\.png: expected one way up", list, source.frames(0, 2))


def test_mirrored_photographs_are_mirrored_back(tmp_path: Path) -> None:
    path = tmp_path / photographs(tmp_path, "png", 0).name.replace("%d", "0")
    with Image.open(path) as picture:
        exif = Image.Exif()
        exif[0x0112] = 5
        picture.save(tmp_path / "mirrored.0.png", exif=exif)
    # EXIF 5: the first row is shown as the left column, the first column as the top row.
    expected = read_image(path).transpose(1, 0, 2)
    np.testing.assert_array_equal(next(open_source(tmp_path / "mirrored.%d.png", "25").frames(0, 1)).rgb, expected)
