"""What a merged stack gives to people: PNG that repeats its photographs, TIFF with a profile, DNG that converters develop alike."""

from dataclasses import replace
from io import BytesIO
from pathlib import Path

import numpy as np
import pytest
from jaxtyping import UInt8
from PIL import Image, ImageCms

from capture.merging.merged_pictures import DEPTH_NAME, DNG_NAME, PNG_NAME, TIFF_NAME, readable_names, write_readable_pictures
from capture.photos.developing import develop
from capture.stacks.ingest import ingest
from mrbokeh.images.color import convert, linear_to_srgb
from mrbokeh.images.picture_codec import stored_rgb, write_stored
from mrbokeh.stacks.focal_stack import FocalStack, write_merged
from tests.support.made_photographs import Picture, make_shoot, only_stack


def merged_like_its_first_slice(stack: FocalStack, picture: Picture | None = None) -> FocalStack:
    """As if every pixel were sharp in slice 0; near at the left, not trusted at the bottom. picture: another one in camera RGB."""
    camera_rgb = stack.slice_camera_rgb(0) if picture is None else picture
    height, width = camera_rgb.shape[:2]
    index = np.tile(np.linspace(0, len(stack) - 1, width, dtype=np.float32), (height, 1))
    confidence = np.where(np.arange(height)[:, None] < 3 * height // 4, 1.0, 0.0) * np.ones((1, width))
    write_merged(stack.folder, camera_rgb, index, confidence.astype(np.float32), None, stack.rec709_from_camera)
    unknown = tuple(replace(each, focus_distance_m=None) for each in stack.slices)
    return replace(stack, slices=unknown, merged=True)


def all_codes() -> UInt8[np.ndarray, "48 64 3"]:
    """Every code of every channel in an order of its own."""
    rng = np.random.default_rng(0)
    return np.stack([rng.permutation(np.arange(48 * 64) % 256).astype(np.uint8).reshape(48, 64) for _ in range(3)], axis=-1)


def jpeg_free_stack(folder: Path, orientation: int | None = None) -> FocalStack:
    """Two PNG of 8 bits, the second flat; orientation: what EXIF says of both."""
    import pyexiv2

    for index, codes in enumerate((all_codes(), all_codes() // 2)):
        write_stored_in(folder / "shoot" / f"{index}.png", codes)
        if orientation is not None:
            with pyexiv2.Image(str(folder / "shoot" / f"{index}.png")) as image:
                image.modify_exif({"Exif.Image.Orientation": str(orientation)})
    return only_stack(ingest([folder / "shoot"], folder / "scene"))


def write_stored_in(path: Path, codes: UInt8[np.ndarray, "height width 3"]) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    write_stored(path, codes)


def test_png_repeats_an_eight_bit_photograph_bit_for_bit(tmp_path: Path) -> None:
    """Through the half floats of its slice: their steps are a ninth of those of 8 bits at most."""
    stack = merged_like_its_first_slice(jpeg_free_stack(tmp_path))
    write_readable_pictures(stack)
    assert readable_names(stack) == [PNG_NAME, TIFF_NAME, DEPTH_NAME] and not (stack.folder / DNG_NAME).exists()
    np.testing.assert_array_equal(stored_rgb(stack.folder / PNG_NAME), all_codes())


def test_tiff_holds_the_curve_in_16_bits_and_says_so(tmp_path: Path) -> None:
    """Half a step of 65535 off, and what is beyond 0 to 1 is clipped."""
    stack = jpeg_free_stack(tmp_path)
    picture = np.linspace(-0.1, 1.3, 48 * 64 * 3, dtype=np.float32).reshape(48, 64, 3)
    write_readable_pictures(merged_like_its_first_slice(stack, picture), picture)
    codes = stored_rgb(stack.folder / TIFF_NAME)
    wanted = np.clip(linear_to_srgb(picture), 0.0, 1.0) * 65535.0
    assert codes.dtype == np.uint16
    assert np.abs(codes - wanted).max() <= 0.51
    with Image.open(stack.folder / TIFF_NAME) as opened:
        profile = ImageCms.ImageCmsProfile(BytesIO(opened.info["icc_profile"]))
    assert "sRGB" in ImageCms.getProfileDescription(profile)


@pytest.mark.parametrize(("orientation", "turns"), [(6, 3), (8, 1), (3, 2)])
def test_pictures_for_people_stand_upright(tmp_path: Path, orientation: int, turns: int) -> None:
    """EXIF 6: the top of the scene is at the right of what is stored, a quarter turn clockwise brings it up."""
    stack = merged_like_its_first_slice(jpeg_free_stack(tmp_path, orientation))
    write_readable_pictures(stack)
    np.testing.assert_array_equal(stored_rgb(stack.folder / PNG_NAME), np.rot90(all_codes(), turns))
    assert stored_rgb(stack.folder / TIFF_NAME).shape == stored_rgb(stack.folder / DEPTH_NAME).shape == np.rot90(all_codes(), turns).shape
    assert stack.all_in_focus().shape == (48, 64, 3)


def test_depth_is_red_near_blue_far_and_grey_where_it_is_a_guess(tmp_path: Path) -> None:
    stack = merged_like_its_first_slice(jpeg_free_stack(tmp_path))
    write_readable_pictures(stack)
    depth = stored_rgb(stack.folder / DEPTH_NAME).astype(int)
    near, far, guessed = depth[10, 2], depth[10, -3], depth[-3]
    assert near[0] > near[2] + 100
    assert far[2] > far[0] + 100
    assert (guessed.max(axis=-1) - guessed.min(axis=-1)).max() < 60 < (depth[10].max(axis=-1) - depth[10].min(axis=-1)).min()


def test_dng_develops_to_the_colours_of_the_stack(tmp_path: Path) -> None:
    """By our own way through LibRaw and by its usual one; lamps at twice the white of green are there, BaselineExposure told."""
    import rawpy

    stack = only_stack(ingest([make_shoot(tmp_path / "shoot")], tmp_path / "scene"))
    merged = merged_like_its_first_slice(stack)
    write_readable_pictures(merged)
    assert DNG_NAME in readable_names(merged)
    path, wanted = stack.folder / DNG_NAME, merged.all_in_focus()
    developed = develop(path, None)
    assert developed.white_balance == pytest.approx(stack.metadata["white_balance"], abs=1e-4)
    assert developed.rec709_from_camera is not None
    own = convert(developed.rgb, np.array(developed.rec709_from_camera))
    # Balanced, red of a full photosite reads 2 and all channels are raised to it: native green is 2, the scale by which all is divided.
    scale = stack.metadata["white_balance"][0]
    quiet = (wanted.max(axis=-1) < 0.7) & (wanted.min(axis=-1) > 0.02)
    assert own[quiet] * scale == pytest.approx(wanted[quiet], abs=2e-4)
    with rawpy.imread(str(path)) as raw:
        usual = raw.postprocess(use_camera_wb=True, output_bps=16, gamma=(1, 1), no_auto_bright=True, output_color=rawpy.ColorSpace.sRGB)
    ratio = np.median(usual[quiet] / 65535.0 / wanted[quiet], axis=0)
    assert ratio * scale == pytest.approx(np.ones(3), rel=0.002), "no tint"
    assert exposure_of(path) == pytest.approx(np.log2(scale), abs=1e-3)
    lamp = 72 // 3 + 3, 96 // 4 + 3
    assert own[lamp] * scale == pytest.approx(wanted[lamp], rel=0.01)
    assert wanted[lamp] == pytest.approx(np.full(3, 2.0), rel=0.01), "a lamp of 4 is cut off where red is full"


def exposure_of(path: Path) -> float:
    import pyexiv2

    with pyexiv2.Image(str(path)) as image:
        numerator, denominator = image.read_exif()["Exif.Image.BaselineExposure"].split("/")
    return int(numerator) / int(denominator)
