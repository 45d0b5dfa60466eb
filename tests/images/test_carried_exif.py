"""EXIF goes on from a photograph to a JPEG or PNG: readable by others, upright, of the new size, and the pixels stay."""

from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from mrbokeh.images.carried_exif import carry_exif
from mrbokeh.images.exif import stored_orientation
from mrbokeh.stacks.photograph import read_photograph


def photo(path: Path, maker_note: bytes = b"") -> Path:
    """A level photograph that was held upright, with lens, time and place."""
    exif = Image.Exif()
    exif[0x010F], exif[0x0112] = "Maker", 6
    details = exif.get_ifd(0x8769)
    details[0x920A], details[0x829D], details[0x9003], details[0xA002], details[0xA003] = 35.0, 2.8, "2024:05:01 10:00:00", 64, 48
    if maker_note:
        details[0x927C] = maker_note
    exif.get_ifd(0x8825)[1] = "N"
    Image.fromarray(np.full((48, 64, 3), 99, np.uint8)).save(path, exif=exif)
    return path


@pytest.mark.parametrize("name", ["made.jpg", "made.png"])
def test_a_made_picture_has_the_facts_of_its_photograph(tmp_path: Path, name: str) -> None:
    codes = np.random.default_rng(1).integers(0, 256, (64, 48, 3)).astype(np.uint8)
    Image.fromarray(codes).save(tmp_path / name)
    before = np.asarray(Image.open(tmp_path / name))
    carry_exif(photo(tmp_path / "photo.jpg", b"note" * 20), tmp_path / name, (48, 64))
    made = Image.open(tmp_path / name)
    np.testing.assert_array_equal(np.asarray(made), before)
    exif = made.getexif()
    details = exif.get_ifd(0x8769)
    assert exif[0x010F] == "Maker" and exif[0x0112] == 1 and stored_orientation(tmp_path / name) == 1
    assert details[0x9003] == "2024:05:01 10:00:00" and (details[0xA002], details[0xA003]) == (48, 64) and 0x927C not in details
    assert exif.get_ifd(0x8825)[1] == "N"
    told = read_photograph(tmp_path / name)
    assert (told.focal_length_mm, told.f_number) == (35.0, 2.8) and told.rgb.shape == (64, 48, 3)


def test_what_cannot_hold_or_has_none_stays_as_it_is(tmp_path: Path) -> None:
    Image.fromarray(np.zeros((4, 4, 3), np.uint8)).save(tmp_path / "plain.png")
    for source, name in (
        (photo(tmp_path / "photo.jpg"), "made.tif"),
        (tmp_path / "plain.png", "made.jpg"),
        (tmp_path / "x.exr", "made.jpg"),
    ):
        Image.fromarray(np.zeros((4, 4, 3), np.uint8)).save(tmp_path / name)
        before = (tmp_path / name).read_bytes()
        carry_exif(source, tmp_path / name, (4, 4))
        assert (tmp_path / name).read_bytes() == before
