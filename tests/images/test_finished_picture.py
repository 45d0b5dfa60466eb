"""Finished pictures: alpha of the plate carried through `mrbokeh composite`, and colour spaces stated in EXR headers."""

from fractions import Fraction
from pathlib import Path
from unittest.mock import Mock

import cv2
import numpy as np
import pytest
from typer.testing import CliRunner

from mrbokeh.commands.composite import app
from mrbokeh.images.alpha_io import alpha_with, read_alpha, write_finished
from mrbokeh.images.color import linear_to_srgb
from mrbokeh.images.color_management import NamedSpace
from mrbokeh.images.exr_io import (
    AP0,
    AP1,
    BT2020,
    P3_D65,
    REC709,
    ExrPart,
    in_rec709,
    known_primaries,
    read_exr,
    rec709_from_chromaticities,
    write_exr,
)
from mrbokeh.images.image_io import read_image, read_layer, write_layer
from mrbokeh.images.layer import Layer
from mrbokeh.optics.lens import Lens
from mrbokeh.optics.lens_file import write_lens

SIZE = (24, 36)
COLOUR = np.array([0.4, 0.2, 0.1], np.float32)
STEP = 1.5 / 65535


def half_covered(columns: int = 12) -> np.ndarray:
    """0.5 in the left third, 0 in the middle, 1 at the right."""
    alpha = np.full(SIZE, 0.5, np.float32)
    alpha[:, columns : 2 * columns], alpha[:, 2 * columns :] = 0.0, 1.0
    return alpha


@pytest.fixture
def files(tmp_path: Path) -> Path:
    """A plate of one colour with alpha, as EXR (premultiplied) and PNG (straight), and an opaque card over its upper rows."""
    alpha = half_covered()
    rgb = (alpha[..., None] * COLOUR).astype(np.float32)
    write_exr(tmp_path / "plate.exr", ExrPart({name: rgb[..., i] for i, name in enumerate("RGB")} | {"A": alpha}))
    codes = np.round(np.dstack([np.broadcast_to(linear_to_srgb(COLOUR)[::-1], (*SIZE, 3)), alpha]) * 65535).astype(np.uint16)
    assert cv2.imwrite(str(tmp_path / "plate.png"), codes)
    cover = np.zeros(SIZE, np.float32)
    cover[:12] = 1.0
    card = Layer(np.repeat(0.8 * cover[..., None], 3, axis=2), cover, np.where(cover > 0, 2.0, np.inf).astype(np.float32))
    write_layer(tmp_path / "card.exr", card, half=False)
    write_lens(tmp_path / "lens.json", Lens(50.0, 8.0, 2.0, 36.0))
    return tmp_path


def stored(path: Path) -> np.ndarray:
    """Blue first, as OpenCV reads it."""
    codes = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    assert codes is not None
    return np.asarray(codes)


def put_in(files: Path, plate: str, out: str, *words: str) -> str:
    arguments = [str(files / plate), "--layer", str(files / "card.exr"), "--lens", str(files / "lens.json"), "--out", str(files / out)]
    result = CliRunner().invoke(app, [*arguments, *words], catch_exceptions=False)
    assert result.exit_code == 0, result.output
    return result.output


@pytest.mark.parametrize("plate", ["plate.exr", "plate.png"])
def test_exr_holds_the_alpha_of_the_plate_under_the_card(files: Path, plate: str) -> None:
    assert "warning" not in put_in(files, plate, "out.exr")
    found = read_layer(files / "out.exr")
    np.testing.assert_allclose(found.alpha[14:], half_covered()[14:], atol=1e-3)
    np.testing.assert_allclose(found.alpha[:10], 1.0, atol=1e-3)
    np.testing.assert_allclose(found.rgb[14:], (half_covered()[..., None] * COLOUR)[14:], atol=1e-3)
    np.testing.assert_allclose(found.rgb[:10], 0.8, atol=1e-3)


@pytest.mark.parametrize("plate", ["plate.exr", "plate.png"])
@pytest.mark.parametrize("suffix", ["png", "tif"])
def test_png_and_tiff_hold_straight_colour(files: Path, plate: str, suffix: str) -> None:
    put_in(files, plate, f"out.{suffix}")
    codes, alpha = stored(files / f"out.{suffix}"), read_alpha(files / f"out.{suffix}")
    assert codes.dtype == np.uint16 and codes.shape == (*SIZE, 4)
    np.testing.assert_allclose(codes[14:, ..., 3] / 65535, half_covered()[14:], atol=STEP)
    np.testing.assert_allclose(codes[16, 4, 2::-1] / 65535, linear_to_srgb(COLOUR), atol=1e-4)  # half covered, not darker
    assert not codes[16, 18, :3].any()
    assert alpha is not None
    np.testing.assert_allclose(alpha, codes[..., 3] / 65535, atol=1e-6)


def test_jpeg_says_that_alpha_is_lost(files: Path) -> None:
    assert "the plate has alpha, which .jpg cannot hold" in put_in(files, "plate.png", "out.jpg")
    found = read_image(files / "out.jpg")
    assert found[18, 18].max() < 0.01 and found[18, 4, 0] == pytest.approx(0.2, abs=0.02)


def test_an_opaque_plate_stays_without_alpha(files: Path) -> None:
    write_exr(files / "opaque.exr", ExrPart(dict.fromkeys("RGBA", np.ones(SIZE, np.float32))))
    put_in(files, "opaque.exr", "out.png")
    assert stored(files / "out.png").shape == (*SIZE, 3)
    assert read_alpha(files / "opaque.exr") is None and read_alpha(files / "out.png") is None


@pytest.mark.parametrize(("channels", "reads"), [("RGB", 0), ("RGBA", 1)])
def test_exr_without_alpha_is_not_read_for_it(files: Path, monkeypatch: pytest.MonkeyPatch, channels: str, reads: int) -> None:
    """Its header tells; pixels are read, once, only where there is alpha."""
    read = Mock(side_effect=read_exr)
    write_exr(files / "half.exr", ExrPart(dict.fromkeys(channels, half_covered())))
    monkeypatch.setattr("mrbokeh.images.alpha_io.read_exr", read)
    assert (read_alpha(files / "half.exr") is not None) == bool(reads)
    assert read.call_count == reads


def test_alpha_turns_with_the_picture(files: Path) -> None:
    turned = read_alpha(files / "plate.png", orientation=8)
    assert turned is not None and turned.shape == SIZE[::-1]
    np.testing.assert_allclose(turned[0, :], half_covered()[:, -1], atol=STEP)  # counter-clockwise: the right side comes up


def test_coverage_adds_up() -> None:
    """0.25 of virtual light before a plate of 0.5: 0.25 + 0.75 * 0.5."""
    plate = np.full((1, 1), 0.5, np.float32)
    assert alpha_with(plate, np.full((1, 1), 0.25, np.float32)) == pytest.approx(0.625)
    assert alpha_with(None, plate) is None


@pytest.mark.parametrize(
    ("name", "primaries"),
    [("ACEScg", AP1), ("ACES2065-1", AP0), ("Linear Rec.2020", BT2020), ("Linear P3-D65", P3_D65), ("Linear Rec.709 (sRGB)", REC709)],
)
def test_the_header_states_the_primaries_of_the_space(files: Path, name: str, primaries: tuple[float, ...]) -> None:
    """By `mrbokeh composite`: read as any EXR it is the same light again, layers too; depth and mattes are the same numbers."""
    pytest.importorskip("PyOpenColorIO")
    put_in(files, "plate.exr", "plain.exr")
    put_in(files, "plate.exr", "out.exr", "--output-space", name)
    (part,) = read_exr(files / "out.exr")
    assert part.attributes["chromaticities"] == pytest.approx(primaries, abs=1e-6)
    assert part.attributes["oiio:ColorSpace"] == name and part.attributes["colorInteropID"].startswith("lin_")
    np.testing.assert_allclose(read_image(files / "out.exr"), read_image(files / "plain.exr"), atol=2e-3)
    (plain,) = read_exr(files / "plain.exr")
    assert plain.attributes["chromaticities"] == pytest.approx(REC709, abs=1e-6) and plain.attributes["oiio:ColorSpace"] == "lin_rec709"
    assert part.channels.keys() == plain.channels.keys()
    for data in ("A", "Z", "coc.px", "matte.A", "virtual.A", "virtual.Z", "sharp.Z"):
        np.testing.assert_array_equal(part.channels[data], plain.channels[data])
    for layer in ("virtual", "sharp"):
        colours = [each.stacked([f"{layer}.{channel}" for channel in "RGB"]) for each in (part, plain)]
        np.testing.assert_allclose(in_rec709(colours[0], primaries, "out.exr"), colours[1], atol=2e-3)


def overscanned(path: Path, margins: tuple[int, int, int, int], **attributes: object) -> ExrPart:
    """A plate of random colour whose display window begins at (5, -3), with so many pixels around it: left, top, right, bottom."""
    left, top, right, bottom = margins
    height, width = SIZE[0] + top + bottom, SIZE[1] + left + right
    rgb = np.random.default_rng(2).random((3, height, width), np.float32)
    display = (np.array([5, -3], np.int32), np.array([5 + SIZE[1] - 1, -3 + SIZE[0] - 1], np.int32))
    data = (display[0] - np.int32([left, top]), display[1] + np.int32([right, bottom]))
    part = ExrPart(dict(zip("RGB", rgb, strict=True)), attributes={"displayWindow": display, "dataWindow": data, **attributes})
    write_exr(path, part)
    return part


def test_windows_overscan_and_metadata_of_a_plate_stay(files: Path) -> None:
    """Where nothing virtual is, every pixel of the data window is the plate's; layers are empty around the display window."""
    import OpenEXR

    code = OpenEXR.TimeCode(10, 20, 30, 12, True, *[False] * 5, *[0] * 8)
    stated = {"timeCode": code, "framesPerSecond": Fraction(24000, 1001), "pixelAspectRatio": 2.0, "reel": "A001"}
    plate = overscanned(files / "wide.exr", (6, 4, 2, 3), acesImageContainerFlag=1, **stated)
    assert "has overscan (6, 4, 2, 3 px left, top, right, bottom)" in put_in(files, "wide.exr", "out.exr")
    with OpenEXR.File(str(files / "out.exr"), separate_channels=True) as file:
        header, red = dict(file.parts[0].header), file.parts[0].channels["R"].pixels
        empty = file.parts[0].channels["sharp.A"].pixels.copy()
    for window in ("displayWindow", "dataWindow"):
        np.testing.assert_array_equal(header[window], plate.attributes[window])
    assert (header["framesPerSecond"], header["pixelAspectRatio"], header["reel"]) == (Fraction(24000, 1001), 2.0, "A001")
    assert str(header["timeCode"]) == str(code) and "acesImageContainerFlag" not in header
    below = np.zeros(red.shape, bool)
    below[4 + 14 :] = True
    below[:, :6] = below[:, 6 + SIZE[1] :] = below[:4] = True
    np.testing.assert_allclose(red[below], plate.channels["R"][below], atol=2**-11)
    np.testing.assert_allclose(red[4:12, 6 : 6 + SIZE[1]], 0.8, atol=2e-3)  # the card
    empty[4 : 4 + SIZE[0], 6 : 6 + SIZE[1]] = 0
    assert not empty.any()
    # A data window within its display window: the picture is black around it, and the result as large as the display window.
    overscanned(files / "small.exr", (-6, -4, -2, -3))
    put_in(files, "small.exr", "small_out.exr")
    (part,) = read_exr(files / "small_out.exr", overscan=True)
    assert part.origin_px == (5, -3) and part.margins_px == (0, 0, 0, 0) and not part.channels["R"][-3:].any()


def test_the_first_of_several_views_is_taken_and_said(files: Path) -> None:
    parts = [
        ExrPart(dict.fromkeys("RGB", np.full(SIZE, light, np.float32)), side, {"view": side})
        for side, light in (("left", 0.3), ("right", 0.6))
    ]
    write_exr(files / "stereo.exr", parts)
    assert "holds the views left, right: left is taken, and written alone" in put_in(files, "stereo.exr", "out.exr")
    assert read_image(files / "out.exr")[20, 5] == pytest.approx([0.3] * 3, abs=1e-3)


def test_unknown_primaries_and_curves_are_not_stated(tmp_path: Path) -> None:
    pytest.importorskip("PyOpenColorIO")
    for name in ("Linear ARRI Wide Gamut 3", "ARRI LogC4"):
        write_finished(tmp_path / "a.exr", np.full((4, 4, 3), 0.2, np.float32), None, NamedSpace(name))
        assert "chromaticities" not in read_exr(tmp_path / "a.exr")[0].attributes


def test_primaries_are_known_by_their_matrix() -> None:
    for primaries in (AP0, AP1, BT2020, P3_D65, REC709):
        matrix = rec709_from_chromaticities(primaries)
        assert matrix is not None and known_primaries(matrix) == primaries
    assert known_primaries(np.diag([1.0, 1.0, 0.9])) is None


def test_curves_are_for_straight_colour(tmp_path: Path) -> None:
    """A half-covered grey: its straight value goes through the curve."""
    pytest.importorskip("PyOpenColorIO")
    alpha, space = np.full((2, 2), 0.5, np.float32), NamedSpace("ARRI LogC4")
    write_finished(tmp_path / "a.exr", np.full((2, 2, 3), 0.1, np.float32), alpha, space)
    expected = 0.5 * space.from_rec709(np.full((1, 1, 3), 0.2, np.float32))[0, 0]
    np.testing.assert_allclose(read_exr(tmp_path / "a.exr")[0].stacked("RGB")[0, 0], expected, atol=1e-3)
