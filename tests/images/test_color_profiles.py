"""Colour profiles of photographs: against littleCMS, and against primaries of published standards."""

import io
import logging
import struct
import zlib
from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import Image, ImageCms

from mrbokeh.images.color import convert, linear_to_srgb, srgb_to_linear
from mrbokeh.images.color_profiles import ADOBE_RGB, UnreadableProfileError, nclx_profile, parsed_icc
from mrbokeh.images.exr_io import P3_D65, rec709_from_chromaticities
from mrbokeh.images.image_io import read_image
from mrbokeh.images.picture_codec import _by_profile
from mrbokeh.stacks.photograph import read_photograph
from tests.support.made_heic import Item, icc, nclx, write_heic

D50 = np.array([0.9642, 1.0, 0.8249])
BRADFORD = np.array([[0.8951, 0.2664, -0.1614], [-0.7502, 1.7135, 0.0367], [0.0389, -0.0685, 1.0296]])
SRGB_CURVE = b"para\0\0\0\0\0\3\0\0" + struct.pack(">5i", *(round(65536 * n) for n in (2.4, 1 / 1.055, 0.055 / 1.055, 1 / 12.92, 0.04045)))
GAMMA_22 = b"curv\0\0\0\0" + struct.pack(">IH", 1, 563)
TABLE = b"curv\0\0\0\0" + struct.pack(">I257H", 257, *(round(65535 * (i / 256) ** 1.8) for i in range(257)))
# Within the gamut of sRGB, so that littleCMS clips nothing in 8 bits.
CODES = np.random.default_rng(0).integers(100, 180, (24, 32, 3), np.uint8)


def made_icc(primaries: tuple[float, ...], curve: bytes) -> bytes:
    """A profile by ICC.1: colorants adapted to D50, one curve for all."""
    xy = np.array(primaries).reshape(4, 2)
    xyz = np.column_stack([xy, 1.0 - xy.sum(axis=1)]).T
    white = xyz[:, 3] / xy[3, 1]
    adapted = np.linalg.solve(BRADFORD, ((BRADFORD @ D50) / (BRADFORD @ white))[:, None] * BRADFORD)
    columns = adapted @ (xyz[:, :3] * np.linalg.solve(xyz[:, :3], white))
    name = b"made\0"
    contents = {b"desc": b"desc\0\0\0\0" + struct.pack(">I", len(name)) + name + bytes(78), b"wtpt": xyz_tag(D50)}
    contents |= {each: xyz_tag(column) for each, column in zip((b"rXYZ", b"gXYZ", b"bXYZ"), columns.T, strict=True)}
    contents |= dict.fromkeys((b"rTRC", b"gTRC", b"bTRC"), curve)
    table, data = struct.pack(">I", len(contents)), b""
    start = 128 + 4 + 12 * len(contents)
    for tag, content in contents.items():
        table += struct.pack(">4sII", tag, start + len(data), len(content))
        data += content + bytes(-len(content) % 4)
    head = struct.pack(">I4sI4s4s4s12x4s28x3i", start + len(data), b"lcms", 0x02400000, b"mntr", b"RGB ", b"XYZ ", b"acsp", *fixed(D50))
    return head.ljust(128, b"\0") + table + data


def fixed(numbers: np.ndarray) -> list[int]:
    return [round(each * 65536) for each in numbers]


def xyz_tag(xyz: np.ndarray) -> bytes:
    return b"XYZ \0\0\0\0" + struct.pack(">3i", *fixed(xyz))


def by_little_cms(codes: np.ndarray, profile: bytes) -> np.ndarray:
    """sRGB codes of the same colours."""
    source, target = ImageCms.ImageCmsProfile(io.BytesIO(profile)), ImageCms.createProfile("sRGB")
    return np.asarray(ImageCms.profileToProfile(Image.fromarray(codes), source, target, ImageCms.Intent.RELATIVE_COLORIMETRIC))


@pytest.mark.parametrize("suffix", [".png", ".jpg", ".webp", ".tif"])
@pytest.mark.parametrize(
    ("primaries", "curve"), [(P3_D65, SRGB_CURVE), (ADOBE_RGB, GAMMA_22), (P3_D65, TABLE)], ids=["p3", "adobe", "table"]
)
def test_profiles_give_what_little_cms_gives(tmp_path: Path, suffix: str, primaries: tuple[float, ...], curve: bytes) -> None:
    """To a code: littleCMS rounds to 8 bits."""
    profile = made_icc(primaries, curve)
    path = tmp_path / f"photo{suffix}"
    Image.fromarray(CODES).save(path, icc_profile=profile, **({"lossless": True} if suffix == ".webp" else {}))
    stored = cv2.cvtColor(cv2.imread(str(path)), cv2.COLOR_BGR2RGB)
    expected = by_little_cms(stored, profile)
    np.testing.assert_allclose(255 * linear_to_srgb(read_image(path)), expected, atol=1.0)
    np.testing.assert_allclose(255 * linear_to_srgb(read_photograph(path).rgb), expected, atol=1.0)
    assert np.abs(stored.astype(int) - expected).max() > 5, "and that is another picture than by sRGB"


def test_profiles_of_16_bits_are_exact(tmp_path: Path) -> None:
    """Display P3 has sRGB's curve, and the matrix of its published primaries."""
    codes = np.random.default_rng(1).integers(0, 65536, (12, 16, 3), np.uint16)
    data = cv2.imencode(".png", codes[..., ::-1])[1].tobytes()
    chunk = b"iCCP" + b"P3\0\0" + zlib.compress(made_icc(P3_D65, SRGB_CURVE))
    (tmp_path / "a.png").write_bytes(
        data[:33] + struct.pack(">I", len(chunk) - 4) + chunk + struct.pack(">I", zlib.crc32(chunk)) + data[33:]
    )
    expected = convert(srgb_to_linear(codes / 65535.0), rec709_from_chromaticities(P3_D65))
    np.testing.assert_allclose(read_image(tmp_path / "a.png"), expected, atol=3e-4)
    assert read_image(tmp_path / "a.png", "linear") == pytest.approx(codes / 65535.0), "plain numbers stay what they are"


def test_srgb_profiles_change_no_bit(tmp_path: Path) -> None:
    Image.fromarray(CODES).save(tmp_path / "plain.png")
    Image.fromarray(CODES).save(tmp_path / "srgb.png", icc_profile=ImageCms.ImageCmsProfile(ImageCms.createProfile("sRGB")).tobytes())
    np.testing.assert_array_equal(read_image(tmp_path / "srgb.png"), read_image(tmp_path / "plain.png"))
    assert nclx_profile({"color_primaries": 1, "transfer_characteristics": 13}) is None


def test_adobe_rgb_of_a_camera_without_a_profile(tmp_path: Path) -> None:
    """DCF 2.0 calls an option file R03; its codes are those of Adobe RGB, with a gamma of 563/256."""
    exif = Image.Exif()
    exif.get_ifd(0x8769)[0xA001] = 0xFFFF
    exif.get_ifd(0x8769)[0xA005] = {1: "R03"}
    Image.fromarray(CODES).save(tmp_path / "_MG_1.jpg", exif=exif, quality=100)
    stored = cv2.cvtColor(cv2.imread(str(tmp_path / "_MG_1.jpg")), cv2.COLOR_BGR2RGB)
    expected = convert(((stored / 255.0) ** (563 / 256)).astype(np.float32), rec709_from_chromaticities(ADOBE_RGB))
    np.testing.assert_allclose(read_image(tmp_path / "_MG_1.jpg"), expected, atol=1e-5)


def test_a_profile_that_cannot_be_read_is_told_once_and_taken_for_srgb(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    path, lab = tmp_path / "photo.jpg", ImageCms.ImageCmsProfile(ImageCms.createProfile("LAB")).tobytes()
    Image.fromarray(CODES).save(tmp_path / "plain.jpg", quality=95)
    for profile, said in (
        (lab, "not one of RGB primaries"),
        (b"rubbish" * 40, "is damaged"),
        (made_icc(P3_D65, b"what" * 4), "unknown kind"),
    ):
        caplog.clear()
        Image.fromarray(CODES).save(path, quality=95, icc_profile=profile)
        with caplog.at_level(logging.WARNING):
            for _ in range(2):
                np.testing.assert_array_equal(read_image(path), read_image(tmp_path / "plain.jpg"))
        assert len(caplog.records) == 1 and said in caplog.text and "taken for sRGB" in caplog.text
    whole = made_icc(P3_D65, TABLE)
    for left in range(0, len(whole), 37):
        with pytest.raises(UnreadableProfileError):
            parsed_icc(whole[:left])


def test_profiles_of_heic(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    """Display P3 by ICC and by nclx are the same picture; HDR is told. Codes may be one off by the rounding of YCbCr."""
    pytest.importorskip("pi_heif")
    smooth = cv2.resize(CODES[:4, :6], (96, 64), interpolation=cv2.INTER_LINEAR)
    profile = made_icc(P3_D65, SRGB_CURVE)
    by_icc = read_image(write_heic(tmp_path / "icc.heic", Item(smooth, (nclx(1, 13), icc(profile)))))
    by_nclx = read_image(write_heic(tmp_path / "nclx.heic", Item(smooth, (nclx(12, 13),))))
    np.testing.assert_allclose(255 * linear_to_srgb(by_icc), by_little_cms(smooth, profile), atol=3.0)
    np.testing.assert_allclose(by_nclx, by_icc, atol=1e-3)
    caplog.clear()
    hdr = read_image(write_heic(tmp_path / "hdr.heic", Item(smooth, (nclx(9, 16),))))
    assert "HDR (PQ)" in caplog.text and "taken for sRGB" in caplog.text
    np.testing.assert_allclose(255 * linear_to_srgb(hdr), smooth, atol=1.5)


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
def test_tables_by_opencv_give_what_curves_give(dtype: type) -> None:
    """The twin applies each curve to each code and multiplies by the matrix."""
    top = np.iinfo(dtype).max
    profile = nclx_profile({"color_primaries": 12, "transfer_characteristics": 4})
    assert profile is not None
    codes = np.random.default_rng(0).integers(0, top, (20, 30, 3), dtype, endpoint=True)
    light = np.stack([curve(codes[..., i] / top) for i, curve in enumerate(profile.curves)], axis=2)
    np.testing.assert_allclose(_by_profile(profile, codes), light @ profile.rec709_from_rgb.T, rtol=1e-5, atol=2e-7)
