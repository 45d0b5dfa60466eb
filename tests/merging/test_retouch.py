"""Retouching a merged stack by masks: what is white becomes that of a slice, the rest stays, and bad input changes nothing."""

import shutil
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from capture.cli import app
from capture.merging.all_in_focus import painted
from capture.merging.merge import merge_scene
from capture.merging.retouch import PAINTED_CONFIDENCE, RETOUCHES, bands_of, read_mask, retouch_scene
from mrbokeh.images.exif import upright
from mrbokeh.images.exr_io import ExrPart, read_exr, write_exr
from mrbokeh.images.picture_codec import stored_rgb, write_stored
from mrbokeh.stacks.focal_stack import FocalStack, read_focal_stack
from mrbokeh.system.errors import InputError
from tests.support.crossing_stack import DISTANCES_M, FAR, NEAR, SIZE, crossing_stack, unmoved
from tests.support.refusals import refused

ON_ITS_SIDE = 6
"""EXIF: a quarter turn clockwise brings the picture upright."""
WHITE = (slice(40, 110), slice(60, 130))
MIDDLE = (slice(70, 80), slice(90, 100))
BEYOND = (slice(0, 8), slice(0, 8))


@pytest.fixture(scope="module")
def original(tmp_path_factory: pytest.TempPathFactory) -> FocalStack:
    folder = tmp_path_factory.mktemp("retouched")
    stack = crossing_stack(folder, orientation=ON_ITS_SIDE)
    return merge_scene(stack.folder, registration=unmoved(folder))[0]


@pytest.fixture
def stack(original: FocalStack, tmp_path: Path) -> FocalStack:
    shutil.copytree(original.folder, tmp_path / "scene" / "view")
    return read_focal_stack(tmp_path / "scene" / "view")


def white(dtype: type, where: tuple[slice, slice] = WHITE) -> np.ndarray:
    """As the sensor saw it."""
    mask: np.ndarray = np.zeros(SIZE, dtype)
    mask[where] = np.iinfo(dtype).max if np.issubdtype(dtype, np.integer) else 1.0
    return mask


def painted_upright(path: Path, mask: np.ndarray) -> Path:
    write_stored(path, upright(mask, ON_ITS_SIDE))
    return path


def test_what_is_white_becomes_that_of_the_slice(stack: FocalStack, tmp_path: Path) -> None:
    before, depth = stack.all_in_focus(), read_exr(stack.depth_path)[0].channels
    changed = retouch_scene(stack.folder, [NEAR], [painted_upright(tmp_path / "mask.png", white(np.uint8))])
    after, slice_rgb = changed.all_in_focus(), changed.slice_rgb(NEAR)
    np.testing.assert_allclose(after[MIDDLE], slice_rgb[MIDDLE], atol=2e-3)
    np.testing.assert_allclose(after[BEYOND], before[BEYOND], atol=1e-6)
    taken = white(np.uint8) > 0
    for name, inside in (("focus_index", NEAR), ("confidence", PAINTED_CONFIDENCE), ("Z", DISTANCES_M[NEAR])):
        values = read_exr(changed.depth_path)[0].channels[name]
        np.testing.assert_allclose(values[taken], inside, rtol=1e-5, err_msg=name)
        np.testing.assert_array_equal(values[~taken], depth[name][~taken], err_msg=name)
    assert read_focal_stack(stack.folder).metadata[RETOUCHES] == [
        {"slice": NEAR, "source": f"{NEAR}.png", "mask": "mask.png", "share": pytest.approx(taken.mean())}
    ]
    people = stored_rgb(stack.folder / "all_in_focus.png").astype(int) - stored_rgb(stack.folder / "all_in_focus.tif").astype(int) / 257.0
    assert people.shape == (SIZE[1], SIZE[0], 3) and np.abs(people).max() < 1.0, "both were written again"


def test_no_edge_of_the_mask_is_seen_where_slices_differ_in_brightness() -> None:
    """A slice that is 10 % brighter: across the edge of the mask its light comes in over the reach of the bands, not at once."""
    picture = np.full((*SIZE, 3), 0.4, np.float32)
    share = (white(np.uint8) > 0).astype(np.float32)
    blended = painted(picture, [(np.float32(1.1) * picture, share)], share, bands_of(share))[75, :, 0]
    assert blended[95] == pytest.approx(0.44, rel=5e-3)
    # A step of 0.04 at once would be seen; the bands go over in some 2^5 px, here in half of that as the mask is narrow.
    assert np.abs(np.diff(blended)).max() < 0.25 * 0.04


def test_grey_blends_and_later_calls_add_up(stack: FocalStack, tmp_path: Path) -> None:
    half = (white(np.uint16) // 2).astype(np.uint16)
    before = stack.all_in_focus()
    grey = retouch_scene(stack.folder, [NEAR], [painted_upright(tmp_path / "half.tif", half)])
    mixed = 0.5 * (np.sqrt(before[MIDDLE]) + np.sqrt(grey.slice_rgb(NEAR)[MIDDLE]))
    np.testing.assert_allclose(np.sqrt(grey.all_in_focus()[MIDDLE]), mixed, atol=5e-3)
    np.testing.assert_array_equal(grey.focus_index(), stack.focus_index(), err_msg="a depth between two things is that of neither")
    masks = [painted_upright(tmp_path / f"{name}.png", white(np.uint8, where)) for name, where in (("a", MIDDLE), ("b", BEYOND))]
    both = retouch_scene(stack.folder.parent, [FAR, 0], masks)
    assert [each["slice"] for each in both.metadata[RETOUCHES]] == [NEAR, FAR, 0]
    again = retouch_scene(stack.folder, [FAR, 0], masks)
    assert again.metadata[RETOUCHES] == both.metadata[RETOUCHES], "the same again is listed once"
    assert (both.focus_index()[MIDDLE] == FAR).all() and (both.focus_index()[BEYOND] == 0).all()


def test_a_merge_anew_drops_retouches_and_says_so(stack: FocalStack, tmp_path: Path) -> None:
    before = stack.all_in_focus()
    (stack.folder.parent / "report.html").write_text("of the picture before")
    retouch_scene(stack.folder, [0], [painted_upright(tmp_path / "mask.png", white(np.uint8))])
    given = ["merge", str(stack.folder), "--overwrite", "--registration", str(unmoved(tmp_path))]
    told = CliRunner().invoke(app, given, env={"COLUMNS": "400"}, catch_exceptions=False).output
    assert "without its retouches (slice 0 by mask.png)" in told
    assert "report.html is of pictures from before: run `mrbokeh capture report" in told
    again = read_focal_stack(stack.folder)
    assert RETOUCHES not in again.metadata
    np.testing.assert_array_equal(again.all_in_focus(), before)


def test_masks_of_every_kind_say_the_same(tmp_path: Path) -> None:
    """Grey, colour and painted on transparency; 8 and 16 bits and float; upright and as the sensor saw it."""
    mask = white(np.uint8)
    opaque, transparent = np.full_like(mask, 255), np.zeros_like(mask)
    kinds = {
        "upright.png": upright(mask, ON_ITS_SIDE),
        "sensor.png": mask,
        "deep.tif": white(np.uint16),
        "colour.tiff": np.dstack([mask, mask, mask]),
        "layer.png": np.dstack([opaque, opaque, opaque, mask]),
        "black_below.png": np.dstack([mask, mask, mask, np.where(mask > 0, opaque, transparent)]),
    }
    for name, pixels in kinds.items():
        write_stored(tmp_path / name, pixels)
    write_exr(tmp_path / "one.exr", ExrPart({"A": white(np.float32)}))
    write_exr(tmp_path / "three.exr", ExrPart({name: white(np.float32) for name in "RGB"}))
    for name in (*kinds, "one.exr", "three.exr"):
        np.testing.assert_array_equal(read_mask(tmp_path / name, SIZE, ON_ITS_SIDE), white(np.float32), err_msg=name)


def test_a_square_mask_stands_as_the_picture_of_its_kind(tmp_path: Path) -> None:
    """Upright and as the sensor saw it have one size: PNG is painted over all_in_focus.png, EXR over all_in_focus.exr."""
    seen = np.zeros((20, 20), np.float32)
    seen[2:5, 2:9] = 1.0
    write_stored(tmp_path / "mask.png", upright((255 * seen).astype(np.uint8), ON_ITS_SIDE))
    write_exr(tmp_path / "mask.exr", ExrPart({"Y": seen}))
    for name in ("mask.png", "mask.exr"):
        np.testing.assert_array_equal(read_mask(tmp_path / name, (20, 20), ON_ITS_SIDE), seen, err_msg=name)


def state_of(folder: Path) -> dict[str, tuple[int, int]]:
    return {str(path): (path.stat().st_mtime_ns, path.stat().st_size) for path in sorted(folder.rglob("*"))}


def test_bad_input_is_one_sentence_and_nothing_changes(stack: FocalStack, tmp_path: Path) -> None:
    good = painted_upright(tmp_path / "good.png", white(np.uint8))
    black = painted_upright(tmp_path / "black.png", np.zeros(SIZE, np.uint8))
    small = painted_upright(tmp_path / "small.png", np.zeros((40, 40), np.uint8))
    photograph = painted_upright(tmp_path / "photograph.png", np.random.default_rng(0).integers(0, 256, SIZE, np.uint8))
    write_exr(tmp_path / "nan.exr", ExrPart({"Y": np.full(SIZE, np.nan, np.float32)}))
    (tmp_path / "broken.png").write_bytes(b"no picture")
    (tmp_path / "mask.jpg").write_bytes(b"")
    before = state_of(stack.folder)
    for slices, masks, match in (
        ([7], [good], r"slices 0 to 6 .*got 7"),
        ([-1], [good], r"slices 0 to 6 .*got -1"),
        ([0, 0], [good, small], r"40 x 40 px.*144 x 192"),
        ([0, 1], [good, black], "black everywhere"),
        ([0], [], "1 of --from-slice and 0 of --mask"),
        ([], [good], "0 of --from-slice and 1 of --mask"),
        ([0], [tmp_path / "none.png"], "no such file"),
        ([0], [tmp_path / "broken.png"], "cannot be read"),
        ([0], [tmp_path / "mask.jpg"], r"\.png or \.tif"),
        ([0], [tmp_path / "nan.exr"], "NaN"),
        ([0], [photograph], "neither black nor white: expected white strokes on black"),
        ([0], [stack.folder / "depth.png"], "read and would be written over"),
    ):
        refused(match, retouch_scene, stack.folder, slices, masks)
    result = CliRunner().invoke(app, ["merge", str(stack.folder), "--from-slice", "1", "--mask", str(good), "--overwrite"])
    assert isinstance(result.exception, InputError) and "leave out --overwrite" in str(result.exception)
    assert state_of(stack.folder) == before


def test_one_merged_stack_is_retouched(stack: FocalStack, tmp_path: Path) -> None:
    good = painted_upright(tmp_path / "good.png", white(np.uint8))
    other = crossing_stack(tmp_path / "other")
    refused("not merged yet", retouch_scene, other.folder, [0], [good])
    shutil.copytree(other.folder, stack.folder.parent / "another")
    refused(r"has 2 stacks.*another", retouch_scene, stack.folder.parent, [0], [good])
