"""A lens file's lens for photographs taken upright and cut out: which side of the sensor lies along the rows, and what is said."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from typer.testing import CliRunner

from mrbokeh.commands.composite import app
from mrbokeh.compositing.open_plate import open_plate
from mrbokeh.images.exif import cut_from_px
from mrbokeh.images.image_io import write_layer
from mrbokeh.images.layer import Layer
from mrbokeh.lens_measuring.matching.photo_facts import read_facts
from mrbokeh.optics.aperture import Aperture
from mrbokeh.optics.lens import Lens
from mrbokeh.optics.lens_file import read_lens, write_lens
from mrbokeh.stacks.photograph import Photograph, lens_for_photograph, read_photograph, turned_by

LEVEL = Lens(50.0, 2.0, 2.0, 36.0)
UPRIGHT = Lens(50.0, 2.0, 2.0, 24.0, sensor_height_mm=36.0)


def photo(path: Path, stored_px: tuple[int, int], orientation: int = 1, taken_px: tuple[int, int] | None = None) -> Path:
    """A JPEG of a full-frame camera: 50 mm f/2 at 2 m, 35 mm equivalent 50 mm. stored_px: width, height."""
    exif = Image.Exif()
    exif[0x0112] = orientation
    width_px, height_px = taken_px or stored_px
    exif.get_ifd(0x8769).update({0x920A: 50.0, 0x829D: 2.0, 0xA405: 50, 0x9206: 2.05, 0xA002: width_px, 0xA003: height_px})
    Image.fromarray(np.full((stored_px[1], stored_px[0], 3), 90, np.uint8)).save(path, exif=exif)
    return path


@pytest.mark.parametrize(("orientation", "width_mm"), [(1, 36.0), (3, 36.0), (6, 24.0), (8, 24.0)])
def test_the_lens_file_agrees_with_the_metadata(tmp_path: Path, orientation: int, width_mm: float) -> None:
    """Of a full frame 24 mm lie along the rows of an upright picture; 35 mm equivalents compare diagonals, so both are exact."""
    path = photo(tmp_path / "photo.jpg", (96, 64), orientation)
    assert open_plate(path).lens.sensor_width_mm == pytest.approx(width_mm)
    assert open_plate(path, lens=LEVEL).lens.sensor_width_mm == pytest.approx(width_mm)
    assert open_plate(path, lens=replace(LEVEL, sensor_height_mm=24.0)).lens.sensor_width_mm == pytest.approx(width_mm)
    assert open_plate(path, lens=UPRIGHT).lens.sensor_width_mm == pytest.approx(width_mm)


@pytest.mark.parametrize(("orientation", "width_mm"), [(1, 23.5), (6, 23.5 * 64 / 96)])
def test_a_stated_sensor_width_is_that_of_the_camera_held_level(tmp_path: Path, orientation: int, width_mm: float) -> None:
    path = photo(tmp_path / "photo.jpg", (96, 64), orientation)
    lens = open_plate(path, facts={"sensor_width_mm": 23.5, "f_number": 4.0}).lens
    assert lens.sensor_width_mm == pytest.approx(width_mm) and (lens.focal_length_mm, lens.f_number) == (50.0, 4.0)


def test_an_upright_picture_has_the_blur_of_the_level_one(tmp_path: Path) -> None:
    """The same camera at the same distance: a disc is as many pixels large, however the camera was held."""
    level, upright = (open_plate(photo(tmp_path / f"{each}.jpg", (96, 64), each), lens=LEVEL) for each in (1, 6))
    assert upright.rgb.shape == (96, 64, 3)
    assert upright.lens.coc_px(4.0, 64) == pytest.approx(float(level.lens.coc_px(4.0, 96)))
    assert upright.camera.focal_px == pytest.approx(level.camera.focal_px)


def test_upright_pictures_are_told_and_turned_ones_asked_about(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    """Without a turn in its EXIF it could be a cut; sensor_height_mm decides it."""
    path = photo(tmp_path / "photo.jpg", (64, 96))
    assert open_plate(path, lens=LEVEL).lens.sensor_width_mm == 36.0
    assert "higher than wide and does not say that it was turned" in caplog.text and "sensor_height_mm" in caplog.text
    assert open_plate(path, lens=replace(LEVEL, sensor_height_mm=24.0)).lens.sensor_width_mm == pytest.approx(24.0)
    caplog.clear()
    open_plate(photo(tmp_path / "level.jpg", (96, 64)), lens=LEVEL)
    open_plate(photo(tmp_path / "made_for.jpg", (96, 64), 6), lens=UPRIGHT)
    assert not caplog.text
    open_plate(photo(tmp_path / "upright.jpg", (96, 64), 6), lens=LEVEL)
    (line,) = caplog.messages
    assert "upright.jpg was taken with the camera held upright: 24 mm of the sensor are taken along its width, 36 mm along" in line


@pytest.mark.parametrize("quarters", [1, 2, 3])
def test_the_opening_turns_as_the_picture_does(quarters: int) -> None:
    """A plain twin: the kernel of the level lens, its pixels turned counter-clockwise as the picture's are."""
    heart = replace(LEVEL, aperture=Aperture.heart(), tilt_rad=(0.1, 0.2))
    turned = turned_by(heart, quarters)
    expected = np.rot90(heart.aperture.rasterize(21.0).kernel, quarters)
    np.testing.assert_allclose(turned.aperture.rasterize(21.0).kernel, expected, atol=1e-9)
    # In focus at a pixel is what was in focus at the pixel that was brought there.
    np.testing.assert_allclose(turned.focus_dioptres(9, 9), np.rot90(heart.focus_dioptres(9, 9), quarters), atol=1e-9)


def test_a_lens_described_upright_is_left_and_survives_its_file(tmp_path: Path) -> None:
    tall = replace(UPRIGHT, aperture=Aperture.heart())
    picture = Photograph(np.zeros((96, 64, 3), np.float32), orientation=6)
    assert lens_for_photograph(tall, picture, tmp_path) == tall
    turned = lens_for_photograph(replace(LEVEL, aperture=Aperture.heart()), picture, tmp_path)
    assert not np.allclose(turned.aperture.outlines[0], tall.aperture.outlines[0])
    for lens in (LEVEL, UPRIGHT):
        write_lens(tmp_path / "lens.json", lens)
        assert read_lens(tmp_path / "lens.json").sensor_height_mm == lens.sensor_height_mm


@pytest.mark.parametrize(
    ("size_px", "taken_px", "expected"),
    [
        ((6000, 4000), (6000, 4000), None),
        ((1500, 1000), (6000, 4000), None),  # resized
        ((1024, 683), (6000, 4000), None),  # resized, rounded to pixels
        ((1000, 1500), (6000, 4000), None),  # turned by a program
        ((3000, 3000), (6000, 4000), (6000, 4000)),
        ((2000, 5000), (6000, 4000), (4000, 6000)),
        ((2000, 4000), (6000, 4000), (6000, 4000)),
        ((3000, 3000), None, None),
    ],
)
def test_what_was_cut_out_has_another_shape(
    size_px: tuple[int, int], taken_px: tuple[int, int] | None, expected: tuple[int, int] | None
) -> None:
    assert cut_from_px(size_px, taken_px) == expected


def test_a_cut_photograph_is_told(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    """Half the width of a full frame is 18 mm."""
    path = photo(tmp_path / "cut.jpg", (48, 48), taken_px=(96, 64))
    assert open_plate(path).lens.sensor_width_mm == pytest.approx(18.0)
    assert read_facts(path, (48, 48)).sensor_width_mm == pytest.approx(18.0)
    assert "cut.jpg of 48x48 px was cut out of 96x64 px" in caplog.text and "18 mm of the sensor are taken along its width" in caplog.text
    caplog.clear()
    assert open_plate(path, lens=LEVEL).lens.sensor_width_mm == 36.0
    (line,) = caplog.messages
    assert "36 mm of the sensor are taken along its width, as --lens says" in line and "--lens has to say 18 mm" in line
    assert read_photograph(photo(tmp_path / "whole.jpg", (48, 32), taken_px=(96, 64))).cut_from_px is None


def test_the_command_says_it(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    write_lens(tmp_path / "lens.json", LEVEL)
    alpha = np.zeros((96, 64), np.float32)
    alpha[40:50, 20:40] = 1.0
    depth_m = np.where(alpha > 0, 4.0, np.inf).astype(np.float32)
    write_layer(tmp_path / "card.exr", Layer(np.repeat(alpha[..., None], 3, 2), alpha, depth_m))
    words = [photo(tmp_path / "photo.jpg", (96, 64), 6), "--layer", tmp_path / "card.exr", "--lens", tmp_path / "lens.json"]
    done = CliRunner().invoke(app, [*map(str, words), "--out", str(tmp_path / "out.png")], catch_exceptions=False)
    assert done.exit_code == 0 and "held upright: 24 mm of the sensor" in caplog.text
