"""EXR files that state primaries: published matrices, our own camera RGB, and files that state none, Rec.709 or nonsense."""

from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from capture.photos.developing import develop
from mrbokeh.commands.render import app as render
from mrbokeh.compositing.open_plate import open_plate
from mrbokeh.images.camera_rgb import chromaticities, matrix3x3, read_camera_rgb, write_camera_rgb
from mrbokeh.images.color import convert
from mrbokeh.images.exr_io import ExrPart, read_exr, rec709_from_chromaticities, write_exr
from mrbokeh.images.image_io import read_image, read_layer, read_linear, write_image
from mrbokeh.layering.light_field_samples import LightFieldSamples, read_samples
from mrbokeh.optics.lens import Lens
from mrbokeh.optics.lens_file import write_lens
from mrbokeh.stacks.focal_stack import FocalStack, write_merged
from tests.support.light_field_files import write_samples
from tests.support.refusals import refused

# Primaries and white of the Academy's documents S-2014-004 (ACEScg) and SMPTE ST 2065-1 (ACES), of ITU-R BT.2020 and BT.709.
ACESCG = (0.713, 0.293, 0.165, 0.830, 0.128, 0.044, 0.32168, 0.33767)
ACES = (0.7347, 0.2653, 0.0, 1.0, 0.0001, -0.0770, 0.32168, 0.33767)
BT2020 = (0.708, 0.292, 0.170, 0.797, 0.131, 0.046, 0.3127, 0.3290)
REC709 = (0.64, 0.33, 0.30, 0.60, 0.15, 0.06, 0.3127, 0.3290)

PUBLISHED = {
    # MaterialX, libraries/cmlib/cmlib_ng.mtlx, acescg_to_lin_rec709: Bradford.
    ACESCG: ((1.70505099, -0.62179212, -0.08325887), (-0.13025642, 1.14080474, -0.01054832), (-0.02400336, -0.12896898, 1.15297233)),
    # OpenColorIO, the CG config for ACES 1.3 that is built in: ACES2065-1 to linear Rec.709, Bradford.
    ACES: ((2.52168619, -1.13413099, -0.38755520), (-0.27647991, 1.37271909, -0.09623917), (-0.01537806, -0.15297534, 1.16835340)),
    # ITU-R BT.2407, linear BT.2020 to BT.709: both with D65, no adaptation.
    BT2020: ((1.6605, -0.5876, -0.0728), (-0.1246, 1.1329, -0.0083), (-0.0182, -0.1006, 1.1187)),
}
# mrbokeh.images.color's XYZ_from_rec709 is rounded and has white at 0.31273, 0.32902: its own digits are off by up to 2.3e-4.
DIGITS = 3e-4
# Linear Rec.709 from the balanced RGB of a plausible camera.
CAMERA = ((1.7, -0.6, -0.1), (-0.3, 1.6, -0.3), (0.05, -0.55, 1.5))

COLOURS = np.array([[[1, 0, 0], [0, 1, 0], [0, 0, 1]], [[1, 1, 1], [0.18, 0.18, 0.18], [40, 20, 0.5]]], np.float32)


def write_colours(path: Path, primaries: tuple[float, ...] | None, rgb: np.ndarray = COLOURS, **more: np.ndarray) -> Path:
    channels = {name: rgb[..., i] for i, name in enumerate("RGB")} | more
    write_exr(path, ExrPart(channels, attributes={} if primaries is None else {"chromaticities": primaries}))
    return path


@pytest.mark.parametrize("primaries", PUBLISHED)
def test_published_colours(tmp_path: Path, primaries: tuple[float, ...]) -> None:
    """Red, green and blue become the columns of the published matrix; white and grey stay, whatever white is stated."""
    read = read_image(write_colours(tmp_path / "a.exr", primaries))
    np.testing.assert_allclose(read[0], np.array(PUBLISHED[primaries]).T, atol=DIGITS)
    np.testing.assert_allclose(read[1, :2], COLOURS[1, :2], rtol=1e-6)
    np.testing.assert_allclose(read[1, 2], np.array(PUBLISHED[primaries]) @ COLOURS[1, 2], atol=60 * DIGITS)
    assert read.dtype == np.float32


def test_half_floats_are_converted_in_float32(tmp_path: Path) -> None:
    """What half floats hold is converted like the same numbers in float; a result in half would be off by 2e-4 and more."""
    held = COLOURS.astype(np.float16)
    read = [read_image(write_colours(tmp_path / "a.exr", ACESCG, each)) for each in (held, held.astype(np.float32))]
    np.testing.assert_array_equal(*read)


@pytest.mark.parametrize("primaries", [None, REC709, (*REC709[:6], 0.312713, 0.329016)])
def test_rec709_is_left_bit_for_bit(tmp_path: Path, primaries: tuple[float, ...] | None) -> None:
    rgb = np.random.default_rng(0).normal(0.0, 100.0, (7, 9, 3)).astype(np.float32)
    rgb[0, 0] = np.inf
    np.testing.assert_array_equal(read_image(write_colours(tmp_path / "a.exr", primaries, rgb)), rgb)


def test_a_layer_is_converted_but_for_alpha_depth_and_further_channels(tmp_path: Path) -> None:
    """Colour premultiplied by alpha stays so: the way from one RGB to another is linear."""
    alpha = np.array([[1.0, 0.5, 0.25], [1.0, 0.0, 0.75]], np.float32)
    path = write_colours(tmp_path / "a.exr", ACES, COLOURS * alpha[..., None], A=alpha, Z=2 * alpha, **{"forward.u": 3 * alpha})
    layer = read_layer(path, extra=True)
    np.testing.assert_allclose(layer.rgb[0], np.array(PUBLISHED[ACES]).T * alpha[0, :, None], atol=DIGITS)
    np.testing.assert_array_equal(layer.alpha, alpha)
    np.testing.assert_array_equal(layer.depth_m, np.where(alpha > 0, 2 * alpha, np.inf))
    np.testing.assert_array_equal(layer.extra["forward.u"][..., 0], 3 * alpha)


def test_parts_of_a_file_share_their_primaries(tmp_path: Path) -> None:
    """OpenEXR lets the first part state them for all, and refuses to write others beside them."""
    depth = ExrPart({"Z": COLOURS[..., 0]}, "depth", {"chromaticities": ACESCG})
    write_exr(tmp_path / "a.exr", [depth, ExrPart({name: COLOURS[..., i] for i, name in enumerate("RGB")}, "colour")])
    assert "chromaticities" not in read_exr(tmp_path / "a.exr")[1].attributes
    np.testing.assert_allclose(read_image(tmp_path / "a.exr")[0], np.array(PUBLISHED[ACESCG]).T, atol=DIGITS)


def test_pixels_that_are_no_numbers_stay_what_they_are(tmp_path: Path) -> None:
    """A matrix would make NaN of an infinite highlight, and spread it to all channels."""
    rgb = COLOURS.copy()
    rgb[0, 0], rgb[1, 0] = (np.inf, 1.0, np.inf), (0.0, np.nan, 0.0)
    path = write_colours(tmp_path / "a.exr", ACESCG, rgb)
    read = read_image(path)
    np.testing.assert_array_equal(read[:, 0], rgb[:, 0])
    np.testing.assert_allclose(read[0, 1:], np.array(PUBLISHED[ACESCG]).T[1:], atol=DIGITS)
    refused("2 pixels are NaN or infinite", read_linear, path)


@pytest.mark.parametrize("seed", range(20))
def test_primaries_of_cameras_lead_back_to_their_matrix(seed: int) -> None:
    """As the header holds them, in float32. Rows sum to 1: balanced grey is grey."""
    matrix = np.eye(3) + np.random.default_rng(seed).uniform(-0.9, 0.3, (3, 3)) * (1 - np.eye(3))
    matrix += np.diag(1.0 - matrix.sum(axis=1))
    stated = chromaticities(matrix3x3(matrix))
    assert stated is not None
    found = rec709_from_chromaticities(np.float32(stated).tolist())
    assert found is not None
    np.testing.assert_allclose(found, matrix, atol=2e-6)


def test_camera_rgb_of_a_stack_is_read_once_as_stored_and_once_converted(tmp_path: Path) -> None:
    """However an all-in-focus picture is read, by its stack, as a picture or as a plate, its colours are the same."""
    plane = np.ones((2, 3), np.float32)
    write_merged(tmp_path, COLOURS, plane, plane, plane, CAMERA)
    stack = FocalStack(tmp_path, (), merged=True, rec709_from_camera=CAMERA)
    np.testing.assert_array_equal(read_camera_rgb(stack.all_in_focus_path), COLOURS)
    np.testing.assert_allclose(stack.all_in_focus()[0], np.array(CAMERA).T, rtol=1e-6)
    lens = Lens(50.0, 2.0, 2.0, 36.0)
    for read in (read_linear(stack.all_in_focus_path), open_plate(stack.all_in_focus_path, lens=lens).rgb):
        np.testing.assert_allclose(read, stack.all_in_focus(), atol=60 * 2e-6)


def test_the_all_in_focus_picture_of_a_raw_stack_is_rendered_in_its_colours(tmp_path: Path) -> None:
    """`mrbokeh render` on what `mrbokeh capture merge` writes gives what the same picture gives in Rec.709."""
    camera_rgb = np.random.default_rng(0).uniform(0.0, 1.0, (16, 24, 3)).astype(np.float32)
    write_exr(tmp_path / "z.exr", ExrPart({"Z": np.linspace(1.0, 4.0, 384, dtype=np.float32).reshape(16, 24)}))
    write_lens(tmp_path / "lens.json", Lens(50.0, 2.0, 2.0, 12.0))
    write_camera_rgb(tmp_path / "camera.exr", camera_rgb, CAMERA, half=False)
    write_image(tmp_path / "rec709.exr", convert(camera_rgb, np.array(CAMERA)), half=False)
    rendered = []
    for name in ("camera.exr", "rec709.exr"):
        words = ["--rgb", name, "--depth", "z.exr", "--lens", "lens.json", "--renderer", "scatter", "--out", f"rendered_{name}"]
        result = CliRunner().invoke(render, [str(tmp_path / word) if "." in word else word for word in words])
        assert result.exit_code == 0, result.output
        rendered.append(read_image(tmp_path / f"rendered_{name}"))
    np.testing.assert_allclose(rendered[0], rendered[1], atol=1e-3)  # half float holds 11 bits of numbers up to 2
    assert np.abs(rendered[1] - camera_rgb).mean() > 0.1, "the two differ by much more than that"


def test_a_slice_with_masks_is_a_picture_too(tmp_path: Path) -> None:
    write_camera_rgb(tmp_path / "a.exr", COLOURS, CAMERA, saturated=np.ones((2, 3), bool), valid=np.ones((2, 3), bool), half=False)
    np.testing.assert_allclose(read_image(tmp_path / "a.exr")[0], np.array(CAMERA).T, atol=2e-6)


def test_aces_pictures_are_ingested_as_rec709(tmp_path: Path) -> None:
    decoded = develop(write_colours(tmp_path / "a.exr", ACES), None)
    assert decoded.rec709_from_camera is None
    np.testing.assert_allclose(decoded.rgb[0], np.array(PUBLISHED[ACES]).T, atol=DIGITS)


def test_samples_of_a_renderer_that_works_in_acescg(tmp_path: Path) -> None:
    zeros = np.zeros((3, 2), np.float32)
    xy_px = np.array([[0.5, 0.5], [1.5, 0.5], [2.5, 0.5]], np.float32)
    write_samples(tmp_path / "a.exr", LightFieldSamples(3, 1, xy_px, zeros, zeros[:, 0], COLOURS[0], zeros[:, 0] + 1, zeros))
    part = read_exr(tmp_path / "a.exr")[0]
    write_exr(tmp_path / "a.exr", ExrPart(part.channels, "sample00", {"chromaticities": ACESCG}))
    read = read_samples(tmp_path / "a.exr")
    np.testing.assert_allclose(read.rgb, np.array(PUBLISHED[ACESCG]).T, atol=DIGITS)
    np.testing.assert_array_equal(read.xy_px, xy_px)


@pytest.mark.parametrize(
    "primaries",
    [
        (0.1, 0.1, 0.2, 0.2, 0.3, 0.3, 0.3127, 0.329),
        (0.64, 0.33, 0.64, 0.33, 0.15, 0.06, 0.3127, 0.329),
        (0.64, 0.33, 0.30, 0.60, 0.15, 0.06, 0.47, 0.465),
        (0.64, 0.33, 0.30, 0.60, 0.15, 0.06, 0.3127, 0.0),
        (0.64, 0.33, 0.30, 0.60, 0.15, 0.06, 0.9, 0.05),
        (0.0,) * 8,
        (float("nan"),) * 8,
    ],
    ids=[
        "collinear",
        "two the same",
        "white on the line from red to green",
        "white without luminance",
        "white no eye sees",
        "zeros",
        "nan",
    ],
)
def test_primaries_that_are_no_colour_space_are_refused_with_advice(tmp_path: Path, primaries: tuple[float, ...]) -> None:
    path = write_colours(tmp_path / "odd.exr", primaries)
    refused(r"odd\.exr: expected primaries .*chromaticities.*, got .*correct the attribute, or remove it", read_image, path)
    np.testing.assert_array_equal(read_camera_rgb(path), COLOURS)
