"""WebP is read like JPEG, with its EXIF; HEIC is refused in one sentence that says how to go on."""

from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from typer.testing import CliRunner

from capture.stacks.ingest import ingest
from mrbokeh.commands.composite import app
from mrbokeh.images.color import srgb_to_linear
from mrbokeh.images.image_io import read_image, write_image, write_layer
from mrbokeh.images.layer import Layer
from mrbokeh.stacks.photograph import read_photograph
from tests.support.made_photographs import only_stack, sources
from tests.support.refusals import refused

CODES = np.random.default_rng(0).integers(0, 256, (24, 32, 3), np.uint8)


def saved_webp(path: Path, codes: np.ndarray = CODES) -> Path:
    """Lossless, turned by a quarter, 50 mm f/2 on 36 mm of film."""
    exif = Image.Exif()
    exif[0x0112] = 6
    exif.get_ifd(0x8769).update({0x920A: 50.0, 0x829D: 2.0, 0xA405: 50, 0x9206: 2.0})
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(codes).save(path, lossless=True, exif=exif)
    return path


def test_webp_is_decoded_from_srgb(tmp_path: Path) -> None:
    """Lossless, so that each code comes back; the curve is that of IEC 61966-2-1."""
    np.testing.assert_allclose(read_image(saved_webp(tmp_path / "photo.webp")), srgb_to_linear(CODES / 255.0), atol=1e-6)
    Image.fromarray(np.dstack([CODES, CODES[..., 0]])).save(tmp_path / "clear.webp", lossless=True, exact=True)
    np.testing.assert_allclose(read_image(tmp_path / "clear.webp"), srgb_to_linear(CODES / 255.0), atol=1e-6)


def test_a_webp_photograph_is_turned_and_tells_its_lens(tmp_path: Path) -> None:
    found = read_photograph(saved_webp(tmp_path / "photo.webp"))
    np.testing.assert_allclose(found.rgb, srgb_to_linear(np.rot90(CODES, 3) / 255.0), atol=1e-6)
    assert (found.focal_length_mm, found.f_number) == (50.0, 2.0)
    # A diagonal of 43.27 mm at 4:3 is 34.6 mm long and 26.0 mm wide, which is what lies along the rows of the upright picture.
    assert found.sensor_width_mm == pytest.approx(25.96, abs=0.01)


def test_composite_takes_a_webp_photograph(tmp_path: Path) -> None:
    """Upright, with the lens of its EXIF: a card at the distance of the focus stays a square, and all else is the photograph's."""
    alpha = np.zeros((32, 24), np.float32)
    alpha[10:20, 5:15] = 1.0
    depth_m = np.where(alpha > 0, 2.0, np.inf).astype(np.float32)
    write_layer(tmp_path / "card.exr", Layer(np.repeat(0.5 * alpha[..., None], 3, axis=2), alpha, depth_m), half=False)
    photo, out = saved_webp(tmp_path / "photo.webp"), tmp_path / "out.exr"
    given = [str(photo), "--layer", str(tmp_path / "card.exr"), "--mode", "over", "--out", str(out)]
    assert CliRunner().invoke(app, given, catch_exceptions=False).exit_code == 0
    upright = srgb_to_linear(np.rot90(CODES, 3) / 255.0)
    np.testing.assert_allclose(read_image(out), np.where(alpha[..., None] > 0, 0.5, upright), rtol=2.0**-11, atol=1e-6)


def test_webp_goes_into_a_stack(tmp_path: Path) -> None:
    for index in range(3):
        saved_webp(tmp_path / "shoot" / f"{index}.webp", np.roll(CODES, index, 1))
    assert sources(only_stack(ingest([tmp_path / "shoot"], tmp_path / "scene"))) == ["0.webp", "1.webp", "2.webp"]


def test_webp_is_not_written(tmp_path: Path) -> None:
    refused(r"cannot write .*\.webp", write_image, tmp_path / "out.webp", np.zeros((4, 4, 3), np.float32))


@pytest.mark.parametrize("name", ["IMG_1.HEIC", "img.heif", "DSC.hif"])
def test_heic_is_refused_with_advice(name: str, tmp_path: Path) -> None:
    (tmp_path / name).write_bytes(b"\0\0\0\x18ftypheic")
    for read in (read_image, read_photograph):
        refused(rf"{name}: HEIC is not read: convert it .* `heif-convert", read, tmp_path / name)


def test_heic_in_a_folder_is_not_passed_over_in_silence(tmp_path: Path) -> None:
    for index in range(3):
        saved_webp(tmp_path / "shoot" / f"{index}.webp", np.roll(CODES, index, 1))
    (tmp_path / "shoot" / "IMG_1.HEIC").write_bytes(b"\0\0\0\x18ftypheic")
    report = ingest([tmp_path / "shoot"], tmp_path / "scene")
    assert [(each.path.name, "HEIC is not read" in each.reason) for each in report.skipped] == [("IMG_1.HEIC", True)]
    (tmp_path / "only").mkdir()
    (tmp_path / "only" / "IMG_1.HEIC").write_bytes(b"\0\0\0\x18ftypheic")
    refused(r"IMG_1\.HEIC: HEIC is not read", ingest, [tmp_path / "only"], tmp_path / "other")
