"""Photographs for compositing: upright, linear, with their lens; from real files of cameras."""

from pathlib import Path

import numpy as np
import pytest
from PIL import Image, ImageOps

from mrbokeh.compositing.open_plate import open_plate
from mrbokeh.images.color import srgb_to_linear
from mrbokeh.images.exif import as_stored, upright
from mrbokeh.stacks.photograph import read_photograph
from tests.support.refusals import refused

DATA = Path(__file__).resolve().parents[3] / "shared" / "data"
shared = pytest.mark.skipif(not DATA.is_dir(), reason="the photographs beside the project are not here")


QUALITY = {".jpg": {"quality": 100, "subsampling": 0}, ".webp": {"lossless": True}}


def saved(path: Path, orientation: int) -> Path:
    ramp = np.random.default_rng(orientation).integers(0, 256, (8, 12, 3), np.uint8)
    exif = Image.Exif()
    exif[0x0112] = orientation
    Image.fromarray(ramp).save(path, exif=exif, **QUALITY.get(path.suffix, {}))
    return path


@pytest.mark.parametrize("orientation", range(1, 9))
def test_pictures_are_turned_as_their_files_ask(orientation: int, tmp_path: Path) -> None:
    """As Pillow turns them, JPEG to the error of two decoders."""
    for name, atol in (("photo.jpg", 0.02), ("photo.tif", 1e-6), ("photo.png", 1e-6), ("photo.webp", 1e-6)):
        path = saved(tmp_path / name, orientation)
        expected = np.asarray(ImageOps.exif_transpose(Image.open(path)))
        found = read_photograph(path).rgb
        np.testing.assert_allclose(found, srgb_to_linear(expected / 255.0), atol=atol, err_msg=name)


@pytest.mark.parametrize("orientation", range(1, 9))
def test_what_is_upright_goes_back(orientation: int) -> None:
    picture = np.arange(18).reshape(2, 3, 3)
    np.testing.assert_array_equal(as_stored(upright(picture, orientation), orientation), picture)


def test_a_quarter_turn_is_counter_clockwise() -> None:
    picture = np.zeros((2, 3, 3), np.float32)
    picture[0, 2] = 1.0  # the upper right corner goes to the upper left
    assert upright(picture, 8)[0, 0, 0] == 1.0


@shared
@pytest.mark.parametrize(
    ("name", "focal_length_mm", "f_number", "focus_m", "sensor_mm"),
    [
        # The D60's DX sensor is 23.6 mm for 3872 px (6.1 um per px, 18.7 mm of them here); 0.45 m counts from the film plane.
        ("exif/nikon_d60_0.45m.jpg", 28.0, 4.5, 0.417, 18.6),
        # The 450D's is 22.2 mm wide; its maker note says 4.46 to 4.84 m.
        ("exif/canon_450d_4.6m.jpg", 100.0, 4.5, 4.54, 22.2),
    ],
)
def test_a_photograph_tells_its_lens(name: str, focal_length_mm: float, f_number: float, focus_m: float, sensor_mm: float) -> None:
    lens = open_plate(DATA / name).lens
    assert (lens.focal_length_mm, lens.f_number) == (focal_length_mm, f_number)
    assert lens.focus_distance_m == pytest.approx(focus_m, rel=0.02)
    assert lens.sensor_width_mm == pytest.approx(sensor_mm, rel=0.02)
    assert open_plate(DATA / name, focus_m=2.0).lens.focus_distance_m == 2.0


@shared
def test_a_raw_file_is_developed() -> None:
    found = read_photograph(DATA / "raw" / "canon_g2_0304.crw")
    assert found.rgb.shape == (1720, 2312, 3) and found.rgb.max() > 0.8 and np.isfinite(found.rgb).all()
    assert found.focal_length_mm == 7.0


def test_without_metadata_the_lens_is_asked_for(tmp_path: Path) -> None:
    photo = saved(tmp_path / "photo.jpg", 1)
    refused(r"unknown: focal length, f-number, sensor width, focus distance.*--lens", open_plate, photo)
