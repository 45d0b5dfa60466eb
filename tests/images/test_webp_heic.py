"""WebP and HEIC are read like JPEG, with their EXIF; HEIC without its extra is refused in one sentence that says how to go on."""

import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from PIL import Image
from typer.testing import CliRunner

from capture.stacks.ingest import ingest
from mrbokeh.commands.composite import app
from mrbokeh.images.color import linear_to_srgb, srgb_to_linear
from mrbokeh.images.exif import stored_orientation
from mrbokeh.images.heif import plane_of
from mrbokeh.images.image_io import read_image, write_image, write_layer
from mrbokeh.images.layer import Layer
from mrbokeh.images.picture_codec import stored_rgb
from mrbokeh.lens_measuring.matching.photo_facts import read_facts
from mrbokeh.stacks.photograph import read_photograph
from tests.support.made_heic import Item, nclx, turned, write_heic
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


def exif_of(orientation: int) -> bytes:
    """50 mm f/2 on 36 mm of film."""
    exif = Image.Exif()
    exif[0x0112] = orientation
    exif.get_ifd(0x8769).update({0x920A: 50.0, 0x829D: 2.0, 0xA405: 50})
    return exif.tobytes()[6:]


SMOOTH = np.stack(np.meshgrid(np.arange(96) * 2, np.arange(64) * 3), axis=2)
SMOOTH = np.dstack([SMOOTH, 255 - SMOOTH[..., 0]]).astype(np.uint8)


@pytest.fixture
def without_heif(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "pi_heif", None)


@pytest.mark.usefixtures("without_heif")
@pytest.mark.parametrize("name", ["IMG_1.HEIC", "img.heif", "DSC.hif"])
def test_heic_without_its_extra_is_refused_with_advice(name: str, tmp_path: Path) -> None:
    (tmp_path / name).write_bytes(b"\0\0\0\x18ftypheic")
    for read in (read_image, read_photograph):
        refused(rf"{name}: HEIC is not read: add the extra .*heic.*, or convert it .* `heif-convert", read, tmp_path / name)


@pytest.mark.usefixtures("without_heif")
def test_heic_in_a_folder_is_not_passed_over_in_silence(tmp_path: Path) -> None:
    for index in range(3):
        saved_webp(tmp_path / "shoot" / f"{index}.webp", np.roll(CODES, index, 1))
    (tmp_path / "shoot" / "IMG_1.HEIC").write_bytes(b"\0\0\0\x18ftypheic")
    report = ingest([tmp_path / "shoot"], tmp_path / "scene")
    assert [(each.path.name, "HEIC is not read" in each.reason) for each in report.skipped] == [("IMG_1.HEIC", True)]
    (tmp_path / "only").mkdir()
    (tmp_path / "only" / "IMG_1.HEIC").write_bytes(b"\0\0\0\x18ftypheic")
    refused(r"IMG_1\.HEIC: HEIC is not read", ingest, [tmp_path / "only"], tmp_path / "other")


def test_heic_of_8_and_10_bits_is_decoded(tmp_path: Path) -> None:
    """Encoded without loss but for the rounding of YCbCr, which is one code in each colour."""
    pytest.importorskip("pi_heif")
    stored = stored_rgb(write_heic(tmp_path / "a.heic", Item(SMOOTH, (nclx(1, 13),))))
    assert stored.dtype == np.uint8 and np.abs(stored.astype(int) - SMOOTH).max() <= 1
    deep = SMOOTH.astype(np.uint16) * 4 + 3
    stored = stored_rgb(write_heic(tmp_path / "b.heic", Item(deep, (nclx(1, 13),))))
    assert stored.dtype == np.uint16 and stored.max() == 65535
    np.testing.assert_allclose(stored / 65535.0, deep / 1023.0, atol=1.6 / 1023)


def test_heic_is_turned_once_and_tells_its_lens(tmp_path: Path) -> None:
    """One counter-clockwise quarter by irot; Exif says 6 (a clockwise one) besides, which must not turn it again."""
    pytest.importorskip("pi_heif")
    path = write_heic(tmp_path / "a.heic", Item(SMOOTH, (nclx(1, 13), turned(1)), exif=exif_of(6)))
    found = read_photograph(path)
    np.testing.assert_allclose(linear_to_srgb(found.rgb), np.rot90(SMOOTH) / 255.0, atol=1.5 / 255)
    assert (found.focal_length_mm, found.f_number, found.orientation) == (50.0, 2.0, 1)
    # A diagonal of 43.27 mm at 3:2 has sides of 36 and 24 mm; the shorter lies along the rows of the upright picture.
    assert found.sensor_width_mm == pytest.approx(24.0, abs=0.01)
    assert read_facts(path, (64, 96)).sensor_width_mm == pytest.approx(24.0, abs=0.01)


def test_exifs_orientation_of_a_heic_is_not_applied(tmp_path: Path) -> None:
    pytest.importorskip("pi_heif")
    path = write_heic(tmp_path / "a.heic", Item(SMOOTH, (nclx(1, 13),), exif=exif_of(6)))
    assert read_photograph(path).rgb.shape == SMOOTH.shape and stored_orientation(path) == 1


def test_heic_goes_into_a_stack(tmp_path: Path) -> None:
    pytest.importorskip("pi_heif")
    (tmp_path / "shoot").mkdir()
    for index in range(3):
        write_heic(tmp_path / "shoot" / f"{index}.heic", Item(np.roll(SMOOTH, index, 1), (nclx(1, 13),)))
    assert sources(only_stack(ingest([tmp_path / "shoot"], tmp_path / "scene"))) == ["0.heic", "1.heic", "2.heic"]


def test_a_damaged_heic_is_one_sentence(tmp_path: Path) -> None:
    pytest.importorskip("pi_heif")
    path = write_heic(tmp_path / "a.heic", Item(SMOOTH, (nclx(1, 13),)))
    whole = path.read_bytes()
    for left in (0, 100, len(whole) - 400):
        path.write_bytes(whole[:left])
        refused(r"a\.heic (is empty|cannot be read)", read_image, path)


@pytest.mark.parametrize("bits", [10, 12])
def test_codes_of_more_than_8_bits_span_16(bits: int) -> None:
    """The twin is the division by the largest code, for every code there is."""
    codes = (np.arange(1 << bits).astype(np.uint16) << (16 - bits)).reshape(1, -1, 1)
    picture = SimpleNamespace(data=codes.tobytes(), mode="L;16", size=(codes.size, 1), info={"bit_depth": bits})
    plain = np.round(np.arange(1 << bits) / ((1 << bits) - 1) * 65535.0)
    np.testing.assert_array_equal(plane_of(picture)[0, :, 0], plain)
