"""Colour spaces by name: known values of the standards, both ways, and what is said where a name is unknown."""

import sys
from pathlib import Path

import numpy as np
import pytest

from mrbokeh.images.color import linear_to_srgb
from mrbokeh.images.color_management import REC709_LINEAR, ColorConversion, open_config, rec709_name
from mrbokeh.images.exr_io import AP1, rec709_from_chromaticities
from mrbokeh.system.errors import MissingExtraError
from tests.support.refusals import refused

ocio = pytest.importorskip("PyOpenColorIO")

# Linear Rec.709 with D65 from ACEScg (AP1, about D60), Bradford: the Academy's published matrix
# (ACES CTL, ACEScsc.Academy.ACEScg and Lib.Academy.ColorSpaces; the same as in "Encoding Characteristics of ACEScg").
REC709_FROM_AP1 = np.array(
    [[1.70505, -0.62179, -0.08326], [-0.13026, 1.14080, -0.01055], [-0.02400, -0.12897, 1.15297]],
)


def grey(value: float) -> np.ndarray:
    return np.full((1, 1, 3), value, np.float32)


def picture() -> np.ndarray:
    return np.random.default_rng(0).uniform(0, 4, (20, 30, 3)).astype(np.float32)


@pytest.mark.parametrize("config", ["aces", "aces-cg"])
def test_acescg_comes_in_through_the_academys_matrix(config: str) -> None:
    primaries = ColorConversion.to_rec709(config, "ACEScg").applied(np.eye(3, dtype=np.float32)[None])
    np.testing.assert_allclose(primaries[0].T, REC709_FROM_AP1, atol=1e-5)
    np.testing.assert_allclose(ColorConversion.to_rec709(config, "ACEScg").applied(grey(1.0)), 1.0, atol=1e-5)


def test_it_agrees_with_the_primaries_of_exr_headers() -> None:
    """The matrix from chromaticities (Bradford) is another way to the same: both give a picture written with AP1 in its header."""
    matrix = rec709_from_chromaticities(AP1)
    assert matrix is not None
    np.testing.assert_allclose(matrix, REC709_FROM_AP1, atol=2e-4)


@pytest.mark.parametrize("space", ["ACEScg", "ACES2065-1", "ARRI LogC4", "S-Log3 S-Gamut3.Cine", "Linear Rec.2020", "lin_rec709_srgb"])
def test_there_and_back_again(space: str) -> None:
    there, back = ColorConversion.from_rec709("aces", space), ColorConversion.to_rec709("aces", space)
    np.testing.assert_allclose(back.applied(there.applied(picture())), picture(), rtol=2e-4, atol=2e-4)


@pytest.mark.parametrize(
    ("space", "code"),
    [
        ("ARRI LogC3 (EI800)", 0.391007),  # ARRI, ALEXA LogC Curve, 2012: mid grey at EI 800 is 400 of 1023
        ("ARRI LogC4", 0.278396),  # ARRI, LogC4 specification, 2022: mid grey of 18 %
        ("S-Log3 S-Gamut3", 420 / 1023),  # Sony, Technical summary for S-Log3: 18 % is code 420 of 10 bits
        ("Log3G10 REDWideGamutRGB", 1 / 3),  # RED, white paper on Log3G10: mid grey is one third
        ("ACEScct", 0.4135884),  # S-2016-001, table of ACEScct values: 0.18
    ],
)
def test_mid_grey_of_camera_curves(space: str, code: float) -> None:
    np.testing.assert_allclose(ColorConversion.to_rec709("aces", space).applied(grey(code)), 0.18, rtol=2e-3)


def test_an_srgb_display_has_the_srgb_curve() -> None:
    ramp = np.linspace(0, 1, 60, dtype=np.float32).reshape(4, 5, 3)
    shown = ColorConversion.from_rec709("aces", "sRGB - Display").applied(ramp)
    np.testing.assert_allclose(shown, linear_to_srgb(ramp), atol=2e-4)


def test_applied_leaves_the_picture_and_apply_changes_it() -> None:
    rgb = picture()
    conversion = ColorConversion.to_rec709("aces", "ACEScg")
    converted = conversion.applied(rgb)
    np.testing.assert_array_equal(rgb, picture())
    # Of any layout in memory.
    np.testing.assert_array_equal(conversion.applied(rgb[:, ::2]), converted[:, ::2])
    conversion.apply(rgb)
    np.testing.assert_array_equal(rgb, converted)
    refused("packed", conversion.apply, rgb[:, ::2])
    assert conversion.applied(np.zeros((0, 4, 3), np.float32)).shape == (0, 4, 3)


def test_the_same_space_changes_nothing() -> None:
    np.testing.assert_array_equal(ColorConversion.of("aces", REC709_LINEAR, REC709_LINEAR).applied(picture()), picture())
    # A role is as good as a name: the ACES configurations work in ACEScg.
    role = ColorConversion.of("aces", "scene_linear", REC709_LINEAR).applied(picture())
    np.testing.assert_array_equal(role, ColorConversion.to_rec709("aces", "ACEScg").applied(picture()))


@pytest.mark.parametrize(("wrong", "near"), [("ACESgc", "ACEScg"), ("arri logc", "ARRI LogC4"), ("slog3", "S-Log3 S-Gamut3")])
def test_unknown_spaces_are_answered_with_near_ones(wrong: str, near: str) -> None:
    for conversion in (ColorConversion.to_rec709, ColorConversion.from_rec709):
        refused(f"no colour space '{wrong}': .*{near}", conversion, "aces", wrong)


def test_configurations_from_files_and_the_environment(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A configuration of its own: "half" is half as bright as linear Rec.709, which goes by its alias here."""
    config = ocio.Config.CreateRaw()
    config.addColorSpace(ocio.ColorSpace(name="lin_rec709", family="", encoding="scene-linear"))
    half = ocio.ColorSpace(name="half")
    half.setTransform(ocio.MatrixTransform(matrix=np.diag([2.0, 2, 2, 1]).ravel().tolist()), ocio.COLORSPACE_DIR_TO_REFERENCE)
    config.addColorSpace(half)
    path = tmp_path / "own.ocio"
    path.write_text(config.serialize())
    assert rec709_name(open_config(path)) == "lin_rec709"
    np.testing.assert_allclose(ColorConversion.to_rec709(path, "half").applied(grey(0.25)), 0.5)
    monkeypatch.setenv("OCIO", str(path))
    np.testing.assert_allclose(ColorConversion.to_rec709(None, "half").applied(grey(0.25)), 0.5)
    monkeypatch.delenv("OCIO")
    refused(r"\$OCIO is not set", ColorConversion.to_rec709, None, "half")


def test_configurations_that_cannot_be_opened(tmp_path: Path) -> None:
    refused("expected an OpenColorIO configuration", open_config, tmp_path / "none.ocio")
    (tmp_path / "bad.ocio").write_text("not: [a config")
    refused("expected an OpenColorIO configuration", open_config, tmp_path / "bad.ocio")
    raw = ocio.Config.CreateRaw()
    refused(r"has no linear Rec\.709", rec709_name, raw)


def test_without_the_package_the_extra_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "PyOpenColorIO", None)
    with pytest.raises(MissingExtraError, match=r"pip install .*\[ocio\]"):
        open_config(tmp_path / "any.ocio")
