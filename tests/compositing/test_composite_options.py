"""What each option of `mrbokeh composite` changes in the picture, and what stays bit for bit."""

import json
import shutil
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from mrbokeh import composite
from mrbokeh.commands._composite_files import plate_by
from mrbokeh.commands._composite_options import CompositeOptions, PlateOptions
from mrbokeh.commands._composited import placing_warning
from mrbokeh.commands.composite import app
from mrbokeh.compositing.choose import best_mode, insertion_of
from mrbokeh.compositing.ground import ended_shadow, with_ground_behind, without_specks
from mrbokeh.compositing.open_plate import open_plate, with_blur_in_metres
from mrbokeh.compositing.plate import plate_of
from mrbokeh.demo.plan import DATA
from mrbokeh.depth.phone_depth import read_phone_photo
from mrbokeh.images.camera_rgb import write_camera_rgb
from mrbokeh.images.exr_io import read_exr
from mrbokeh.images.image_io import read_image, read_layer, write_image, write_layer
from mrbokeh.images.layer import Layer, flatten
from mrbokeh.optics.camera import Camera
from mrbokeh.optics.lens import Lens
from mrbokeh.optics.lens_file import write_lens
from mrbokeh.renderers.scatter_reference import ScatterReference
from mrbokeh.stacks.exr_layers.composite_exr import write_deep_exr
from mrbokeh.stacks.exr_layers.deep_layers import DeepSamples, DeepSurfaces
from mrbokeh.stacks.focal_stack import FocalStack, Slice, read_focal_stack, write_focal_stack, write_merged
from tests.project.test_user_mistakes import said
from tests.support.card_stack import SIZE, make_card_stack
from tests.support.command_line import mrbokeh, printed_by
from tests.support.composite_exr_reader import read_composite_exr
from tests.support.refusals import refused

HEIGHT, WIDTH = 96, 144
LENS = Lens(35.0, 2.0, 2.0, 23.5)
CAKE = DATA / "objects" / "cakeBirthday.glb"
GREY = 0.3


def plate_rgb() -> np.ndarray:
    return np.random.default_rng(0).normal(GREY, 0.02, (HEIGHT, WIDTH, 3)).astype(np.float32)


@pytest.fixture(scope="module")
def written(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A grey wall at 2 m in focus, a post at 0.8 m in its left third, and a white card at 1.3 m."""
    tmp_path = tmp_path_factory.mktemp("files")
    write_image(tmp_path / "photo.exr", plate_rgb(), half=False)
    depth_m = np.full((HEIGHT, WIDTH), 2.0, np.float32)
    depth_m[:, : WIDTH // 3] = 0.8
    write_layer(tmp_path / "depth.exr", Layer(plate_rgb(), np.ones_like(depth_m), depth_m))
    write_image(tmp_path / "near.png", np.repeat((depth_m < 1.0)[..., None], 3, axis=2).astype(np.float32), "linear")
    write_image(tmp_path / "disparity.png", np.repeat((0.8 / depth_m)[..., None], 3, axis=2), "linear")
    write_lens(tmp_path / "lens.json", LENS)
    alpha = np.zeros((HEIGHT, WIDTH), np.float32)
    alpha[30:70, 30:90] = 1.0
    card = Layer(np.repeat(alpha[..., None], 3, axis=2), alpha, np.where(alpha > 0, 1.3, np.inf).astype(np.float32))
    write_layer(tmp_path / "card.exr", card, half=False)
    write_deep_exr(tmp_path / "deep.exr", [card])
    return tmp_path


@pytest.fixture
def files(written: Path, tmp_path: Path) -> Path:
    """Those files, to write beside."""
    return shutil.copytree(written, tmp_path, dirs_exist_ok=True)


def put_in(files: Path, *words: object, photo: str = "photo.exr", card: str | None = "card.exr") -> np.ndarray:
    """The picture in linear light. Errors are raised here."""
    out = files / f"out{len(list(files.iterdir()))}.exr"
    virtual = () if card is None else ("--layer", files / card)
    arguments = (files / photo, "--lens", files / "lens.json", *virtual, *words)
    printed_by(app, *arguments, "--out", out)
    return read_image(out)


def changed(one: np.ndarray, other: np.ndarray) -> np.ndarray:
    return np.abs(one - other).max(axis=2) > 2e-3


def test_depth_hides_a_part_and_may_come_as_disparity(files: Path) -> None:
    before, behind = put_in(files), put_in(files, "--depth", files / "depth.exr")
    assert before[50, 35].min() > 0.9 and behind[50, 35].max() < 0.5
    np.testing.assert_array_equal(before[50, 60:80], behind[50, 60:80])
    # 0.8 / depth is even in dioptres: 1 (white) at 0.8 m, 0 at infinity.
    words = ("--depth", files / "disparity.png", "--disparity", "0.8:inf", "--mode", "over")
    stated = put_in(files, "--depth", files / "depth.exr", "--mode", "over")
    assert changed(put_in(files, *words), stated).mean() < 0.01
    np.testing.assert_allclose(put_in(files, card="deep.exr"), put_in(files), atol=2e-3)


def test_a_sharp_picture_of_the_photograph_gives_what_stands_behind_the_near_edge(files: Path) -> None:
    """As the same arrays do from Python; without it the edge is put together of the photograph alone."""
    with_sharp = put_in(files, "--depth", files / "depth.exr", "--rgb", files / "depth.exr")
    plate, depth_m, card = read_image(files / "photo.exr"), read_layer(files / "depth.exr").depth_m, read_layer(files / "card.exr")
    by_arrays = composite(plate, card, LENS, depth_m=depth_m, all_in_focus=plate_rgb())
    np.testing.assert_allclose(with_sharp, by_arrays, atol=2e-3)
    assert changed(with_sharp, put_in(files, "--depth", files / "depth.exr"))[30:70, 40:56].any()


def test_a_phones_photograph_brings_its_depth_and_its_sharp_original(shared_data: Path) -> None:
    path = shared_data / "rgbd" / "phone_lens_blur_gdepth.jpg"
    phone, plate = read_phone_photo(path), plate_by(CompositeOptions(path), None, lens=None, focus_m=None)
    assert (
        phone is not None
        and phone.focus is not None
        and plate.sharp_rgb is not None
        and plate.depth_m is not None
        and best_mode(plate) == "between"
    )
    np.testing.assert_array_equal(plate.sharp_rgb, phone.original_rgb)
    # The lens is one with the blur that the phone put on: as GFocus states it, whatever the field of view.
    assert plate.lens.coc_px(np.inf, 768) == pytest.approx(2.0 * phone.focus.blur_at_infinity * 1024, rel=1e-6)
    assert plate.lens.focus_distance_m == phone.focus.focus_distance_m
    assert 1.0 <= plate.depth_m.min() < plate.depth_m.max() <= 390.6 / 12.42, "within Near and Far of the file, Near at a metre"


def test_the_ground_never_hides_what_stands_on_it_and_a_post_before_it_does() -> None:
    """A table whose depth grows upwards from 1 to 2 m, wrong by 8 % in its right half above the foot, where it seems nearer."""
    rows, columns = np.mgrid[:HEIGHT, :WIDTH].astype(np.float32)
    table_m = 1.0 + (HEIGHT - 1 - rows) / HEIGHT
    wrong_m = table_m * (1.0 - np.clip((columns - WIDTH / 2) / 80, 0, 0.08) * (rows < 70)).astype(np.float32)
    wrong_m[50:, 20:40] = 0.5
    # A can whose depth goes on from the table over 22 columns, less than 2 % from one to the next, as depth from focus does.
    wrong_m[:, 44:66] = table_m[70, 72] * np.exp(-0.018 * (66 - columns[:, 44:66]))
    alpha = ((rows >= 30) & (rows <= 70) & (columns >= 10) & (columns < 130)).astype(np.float32)
    foot_m = float(table_m[70, 72])
    card = Layer(np.repeat(alpha[..., None], 3, axis=2), alpha, np.where(alpha > 0, foot_m, np.inf).astype(np.float32))
    plate = plate_of(plate_rgb(), replace(LENS, focus_distance_m=foot_m), wrong_m)
    hidden, whole = (
        insertion_of("over").insert(each, [card], ScatterReference()).rgb for each in (plate, with_ground_behind(plate, [(72, 70)], [card]))
    )
    assert hidden[66, 98].max() < 0.5 < 0.95 < whole[66, 98].min(), "where depth is wrong"
    assert whole[60, 30].max() < 0.5, "the post, whose own foot is nearer"
    assert whole[60, 47].max() < 0.5, "the can, which is nearer than the foot"
    np.testing.assert_array_equal(hidden[80:], whole[80:])


def test_depth_of_a_stack_hides_only_by_more_than_it_may_be_off() -> None:
    """A table at 2 m, off by 0.015 dioptres below the foot. A step of 0.05 dioptres above it, not a tenth of the distance, is more than
    what lies between two slices.
    """
    rows, columns = np.mgrid[:HEIGHT, :WIDTH].astype(np.float32)
    ramp = np.clip((columns - WIDTH / 2) / 40.0, 0.0, 1.0)
    below_m, above_m = 1.0 / (0.5 + 0.015 * ramp), 1.0 / (0.5 + 0.05 * ramp)
    alpha = ((rows >= 30) & (rows <= 90)).astype(np.float32)
    card = Layer(np.repeat(alpha[..., None], 3, axis=2), alpha, np.where(alpha > 0, 2.0, np.inf).astype(np.float32))
    lens = replace(LENS, focus_distance_m=2.0)
    plate = plate_of(plate_rgb(), lens, np.where(rows > 70, below_m, above_m).astype(np.float32))
    for error, is_seen_below in ((0.02, True), (0.01, False)):
        stack = with_ground_behind(replace(plate, depth_error_dioptres=error), [(10, 70)], [card])
        seen = insertion_of("over").insert(stack, [card], ScatterReference()).rgb.min(axis=2) > 0.95
        assert seen[80, WIDTH - 10] == is_seen_below and not seen[50, WIDTH - 10] and seen[50, 10] and seen[80, 10]


def test_specks_of_depth_cut_no_holes_and_what_surely_stands_before_does() -> None:
    """Four small parts before a card at 0.5 dioptres, slices 0.04 apart: unsure; near it; far before it; near it, at its edge."""
    depth_m, confidence = np.full((HEIGHT, WIDTH), 4.0, np.float32), np.full((HEIGHT, WIDTH), 0.8, np.float32)
    alpha = np.zeros((HEIGHT, WIDTH), np.float32)
    alpha[10:90, 10:130] = 1.0
    parts = {(20, 20): (1.0, 0.02, True), (40, 40): (0.55, 0.8, True), (60, 60): (1.0, 0.8, False), (70, 8): (0.55, 0.8, False)}
    for (row, column), (dioptres, trust, _) in parts.items():
        depth_m[row : row + 4, column : column + 4], confidence[row : row + 4, column : column + 4] = 1.0 / dioptres, trust
    card = Layer(np.repeat(alpha[..., None], 3, axis=2), alpha, np.where(alpha > 0, 2.0, np.inf).astype(np.float32))
    plate = replace(plate_of(plate_rgb(), LENS, depth_m), depth_confidence=confidence, depth_error_dioptres=0.02)
    found_m = without_specks(plate, [card]).depth_m
    assert found_m is not None
    for (row, column), (*_, is_speck) in parts.items():
        assert (found_m[row + 1, column + 2] == 2.0) == is_speck


def test_the_border_that_a_moved_slice_lacks_is_blurred_anew(tmp_path: Path) -> None:
    """Its lens and its scene are known exactly; another renderer is off by at most 0.02 on average, where lost pixels show zeros."""
    stack = make_card_stack(tmp_path / "stack", 3)
    truth, valid = stack.slice_rgb(1), np.ones(SIZE, bool)
    valid[:, :12] = False
    write_camera_rgb(stack.folder / stack.slices[1].path, np.where(valid[..., None], truth, np.float32(0.0)), None, valid=valid, half=False)
    found = open_plate(stack.folder, 1).rgb
    np.testing.assert_array_equal(found[:, 12 + 24 :], truth[:, 12 + 24 :])
    assert np.abs(found - truth)[:, : 12 + 24].mean() < 0.02 < 0.2 < truth[~valid].mean()


def test_blur_stays_when_depth_is_told_in_metres() -> None:
    """A phone's depth of 10 to 40 units, focused at 16, is told to be 1 to 20 m: dioptres go from 0.1..0.025 to 1..0.05."""
    units = np.linspace(10.0, 40.0, HEIGHT * WIDTH, dtype=np.float32).reshape(HEIGHT, WIDTH)
    told_m = (1.0 / (0.05 + (1.0 / units - 0.025) * 0.95 / 0.075)).astype(np.float32)
    lens = replace(LENS, focus_distance_m=16.0, f_number=0.05)
    plate = with_blur_in_metres(plate_of(plate_rgb(), lens, told_m), units, None)
    assert plate.depth_m is not None and plate.lens.focus_distance_m == pytest.approx(1 / (0.05 + 0.0375 * 0.95 / 0.075), rel=1e-4)
    np.testing.assert_allclose(
        plate.lens.coc_px(plate.depth_m, WIDTH), lens.coc_px(units, WIDTH), atol=0.02 * np.abs(lens.coc_px(units, WIDTH)).max()
    )


def test_a_shadow_ends_where_the_table_ends() -> None:
    """A table to column 80 and a wall at 8 m beyond: the shadow lies on a plane without end, 60 columns wide. The table seems 5% farther,
    with noise of 3% in each pixel. A shadow that the foot does not touch, of something in the air, stays.
    """
    rows, columns = np.mgrid[:HEIGHT, :WIDTH].astype(np.float32)
    plane_m = 1.0 + (HEIGHT - 1 - rows) / HEIGHT
    noise = np.random.default_rng(0).normal(1.05, 0.03, (HEIGHT, WIDTH)).astype(np.float32)
    plate = plate_of(plate_rgb(), replace(LENS, focus_distance_m=1.5), np.where(columns < 80, plane_m * noise, np.float32(8.0)))
    alpha = ((abs(rows - 60) < 10) & (abs(columns - 90) < 30)).astype(np.float32)
    shadow = Layer(np.zeros((HEIGHT, WIDTH, 3), np.float32), alpha, np.where(alpha > 0, plane_m, np.inf).astype(np.float32))
    ended = ended_shadow(plate, [(65, 60)], shadow, shadow).alpha
    # A pixel's depth is that of 5x5, so that the edge is found two pixels off at most.
    np.testing.assert_array_equal(ended[:, :78], alpha[:, :78])
    np.testing.assert_array_equal(ended[:, 82:], 0.0)
    np.testing.assert_array_equal(ended_shadow(plate, [(20, 60)], shadow, shadow).alpha, alpha)


def test_what_stands_on_the_ground_does_not_catch_its_shadow() -> None:
    """A post from row 64 upwards, whose depth goes on from the ground at its foot: it is as near at all heights, the ground is not."""
    rows, columns = np.mgrid[:HEIGHT, :WIDTH].astype(np.float32)
    plane_m = 1.0 + (HEIGHT - 1 - rows) / HEIGHT
    post = (abs(columns - 90) < 12) & (rows < 64)
    plate = plate_of(plate_rgb(), replace(LENS, focus_distance_m=1.5), np.where(post, plane_m[64, 0], plane_m))
    alpha = ((abs(rows - 50) < 40) & (abs(columns - 80) < 40)).astype(np.float32)
    ended = ended_shadow(plate, [(60, 60)], *[Layer(np.zeros((HEIGHT, WIDTH, 3), np.float32), alpha, plane_m)] * 2)
    higher = post & (plane_m[64, 0] < 0.87 * plane_m)
    assert higher.any() and ended.alpha[higher & (alpha > 0)].max() == 0.0
    np.testing.assert_array_equal(ended.alpha[~post], alpha[~post])


@pytest.mark.parametrize(
    ("at", "height", "told"),
    [
        ("0,0.15,1.5", "0.001", "smaller than a pixel; --height 0.001"),
        ("0,2,1.5", "4", "across the whole picture; --height 4"),
        ("0,0.0015,0.008", "0.002", "100% of what is put in all but touches the lens"),
        ("0,0.15,1.5", "0.3", ""),
    ],
)
def test_a_size_that_nobody_means_is_told(files: Path, at: str, height: str, told: str) -> None:
    """The cake stands at 1.5 m, where a pixel is 7 mm wide: the frame of 144 x 96 px is about 1 m x 0.7 m there."""
    words = (files / "photo.exr", "--lens", files / "lens.json", "--object", CAKE, "--at", at, "--height", height, "--shadow", 0)
    done = mrbokeh("composite", *words, "--out", files / "out.exr")
    assert done.returncode == 0 and ("warning" in done.stderr) == bool(told) and told in done.stderr


def test_a_matte_with_its_distance_does_without_depth(files: Path) -> None:
    """The post is 1.0 / 0.8 - 1 / 2 = 0.75 dioptres out of focus: its edge at column 48 is soft, and the card shines through it."""
    picture = put_in(files, "--matte", files / "near.png", "--near-distance", "0.8")
    sharp = put_in(files, "--depth", files / "depth.exr", "--mode", "over")
    row = picture[50].mean(axis=1)
    assert row[35] < 0.5 and row[60] > 0.9
    # Two neighbours of the noise, meaned over three colours, differ by 0.016 (one sigma).
    assert (np.diff(row[44:54]) > -0.07).all() and changed(picture, sharp)[50, 44:54].any()
    refused("for the mode between", put_in, files, "--matte", files / "near.png", "--near-distance", "0.8", "--mode", "over")


@pytest.mark.parametrize("mode", ["front", "over", "matte", "between"])
def test_every_mode_leaves_what_it_does_not_touch(files: Path, mode: str) -> None:
    picture = put_in(files, "--depth", files / "depth.exr", "--mode", mode)
    stored = plate_rgb().astype(np.float16).astype(np.float32)
    np.testing.assert_array_equal(picture[:20], stored[:20])
    assert changed(picture, stored)[50, 70]


def test_sharp_layers_go_out_as_a_deep_picture(files: Path) -> None:
    """A second card stands behind the first and is seen beside it: two samples where both are, and flat it is what was put in."""
    alpha = np.zeros((HEIGHT, WIDTH), np.float32)
    alpha[40:80, 60:110] = 0.5
    behind = Layer(np.repeat(0.4 * alpha[..., None], 3, axis=2), alpha, np.where(alpha > 0, 1.8, np.inf).astype(np.float32))
    write_layer(files / "behind.exr", behind, half=False)
    put_in(files, "--layer", files / "behind.exr", "--save-deep", files / "virtual.exr")
    deep = DeepSamples.read(files / "virtual.exr")
    counts = deep.counts.reshape(HEIGHT, WIDTH)
    assert (counts[50, 70], counts[50, 40], counts[50, 100], counts[5, 5]) == (2, 1, 1, 0)
    at = deep.starts[50 * WIDTH + 70]
    assert deep.front_m[at : at + 2] == pytest.approx([1.3, 1.8], rel=1e-6)
    read, sharp = flatten(DeepSurfaces().layers(files / "virtual.exr")), flatten([read_layer(files / "card.exr"), behind])
    np.testing.assert_allclose(read.rgb, sharp.rgb, atol=2**-11)
    np.testing.assert_allclose(read.alpha, sharp.alpha, atol=2**-11)
    # Put in again it gives the same picture.
    again = put_in(files, card="virtual.exr")
    np.testing.assert_allclose(again, put_in(files, "--layer", files / "behind.exr"), atol=2e-3)
    refused("--save-deep: expected a name", put_in, files, "--save-deep", files / "virtual.png")
    refused("exists already", put_in, files, "--save-deep", files / "virtual.exr")


@pytest.mark.parametrize(
    ("words", "named"),
    [
        (("--save-deep", "other.exr"), "--save-deep"),
        (("--save-layer", "layer.exr", "--output-space", "ACEScg"), "--output-space, --save-layer"),
        (("--grain", "auto", "--seed", "3", "--light-wrap", "0.5"), "--grain, --light-wrap, --seed"),
        (("--slice", "1", "--depth", "depth.exr", "--focus", "2"), "--slice, --depth, --focus"),
    ],
)
def test_options_of_one_picture_are_refused_for_all_slices(
    words: tuple[str, ...], named: str, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    code, told = said(capsys, monkeypatch, "composite", "stack", "--all-slices", *words, "--out", "made")
    assert code == 2 and f"but got {named}, of one picture: leave that out, or leave --all-slices out" in told


def test_an_exr_holds_all_that_it_was_put_together_from(files: Path) -> None:
    put_in(files, "--depth", files / "depth.exr", "--mode", "over")
    found = read_composite_exr(next(files.glob("out*.exr")))
    assert set(found.layers) == {"virtual", "sharp"} and found.matte is not None and found.coc_px is not None and found.depth_m is not None
    rest = found.rgb - found.layers["virtual"].rgb
    np.testing.assert_allclose(rest[50, 100], plate_rgb()[50, 100], atol=1e-3)
    assert found.depth_m[50, 70] == pytest.approx(1.3) and found.depth_m[50, 10] == pytest.approx(0.8)
    assert found.coc_px[50, 70] == pytest.approx(float(LENS.coc_px(1.3, WIDTH)), rel=1e-3)
    np.testing.assert_array_equal(found.matte, found.layers["virtual"].alpha)


def test_grain_and_a_grey_card_change_virtual_light_alone(files: Path) -> None:
    """A card of 18 % that reads 0.3 in the plate makes the white card 1 / 0.18 * 0.3 = 1.67."""
    plain = put_in(files)
    grey = put_in(files, "--match-grey", "120,20,8")
    grainy = put_in(files, "--grain", "auto", "--seed", "3")
    other_grain = put_in(files, "--grain", "auto", "--seed", "4")
    assert grey[50, 70] == pytest.approx(np.full(3, GREY / 0.18), rel=0.02)
    inside = np.s_[40:60, 45:80]
    assert grainy[inside].std() > 0.01 > plain[inside].std() and changed(grainy, other_grain)[inside].any()
    for picture in (grey, grainy):
        np.testing.assert_array_equal(picture[:20], plain[:20])


def test_distortion_bends_what_is_rendered(files: Path) -> None:
    """A barrel of -0.3 at the unit of the focal length, 216 px, pulls what stands 50 px aside to the middle by 0.3 * (50/216)^2 = 1.6 %."""
    (files / "barrel.json").write_text(json.dumps({"model": "opencv", "k1": -0.3}))
    standing = ("--object", CAKE, "--at", "0.5,0.1,2", "--height", "0.2", "--shadow", "0")
    columns = []
    for words in ((), ("--distortion", files / "barrel.json")):
        picture = put_in(files, *standing, *words, card=None)
        columns.append(float(np.average(np.arange(WIDTH), weights=changed(picture, plate_rgb()).sum(axis=0))))
    assert 0.2 < columns[0] - columns[1] < 2.0


def test_the_ground_catches_a_shadow_or_all_that_changes(files: Path) -> None:
    standing = ("--object", CAKE, "--at", "0,0.2,2", "--height", "0.2", "--pitch", "25", "--sun", "-50,40")
    none, shadow, light, half = (
        put_in(files, *standing, *words, card=None)
        for words in (("--shadow", "0"), ("--catch", "shadow"), ("--catch", "light"), ("--shadow", "0.5"))
    )
    darker = [float((none - each).clip(0).sum()) for each in (shadow, light, half)]
    assert min(darker) > 1.0, "all darken the ground"
    assert changed(shadow, light).any()
    assert darker[2] == pytest.approx(0.5 * darker[1], rel=0.05)


def test_a_colour_match_leaves_the_colour_of_shadowed_ground(files: Path) -> None:
    """White balance and vignetting change the cake's light alone: its shadow lies on ground whose light has gone through the lens."""
    standing = ("--object", CAKE, "--at", "0,0.2,2", "--height", "0.2", "--pitch", "25", "--sun", "-50,20", "--grain", "off")
    alone = put_in(files, *standing, "--shadow", "0", card=None)
    cake = cv2.dilate(changed(alone, plate_rgb()).astype(np.uint8), np.ones((9, 9))) > 0
    plain = put_in(files, *standing, card=None)
    ground = changed(plain, plate_rgb()) & ~cake
    assert ground.sum() > 200, "there is a shadow beside the cake"
    for words in (("--match-white", "3500"), ("--vignetting=-0.6",)):
        other = put_in(files, *standing, *words, card=None)
        assert changed(other, plain)[cake].any()
        np.testing.assert_allclose(other[ground], plain[ground], rtol=2e-3, atol=1e-3)
        assert np.abs(plain - plate_rgb())[ground].max() > 0.05


def test_a_scene_file_with_its_camera(files: Path) -> None:
    """Seen from 5 cm to the right the cake stands 0.05 / 2 * 216 px = 5.4 px farther left."""
    cake = f'[[object]]\nname = "cake"\nglb = "{CAKE}"\nposition_m = [0.0, 0.1, 2.0]\nheight_m = 0.2\n'
    (files / "scene.toml").write_text(f'up = "-y"\n{cake}')
    focal_px = LENS.focal_px(WIDTH)
    camera = {"width_px": WIDTH, "height_px": HEIGHT, "focal_px": [focal_px, focal_px], "principal_px": [WIDTH / 2, HEIGHT / 2]}
    pose = np.eye(4)
    pose[0, 3] = -0.05
    (files / "camera.json").write_text(json.dumps(camera | {"camera_from_world": pose.tolist()}))
    columns = []
    for words in ((), ("--camera", files / "camera.json")):
        picture = put_in(files, "--scene", files / "scene.toml", *words, card=None)
        columns.append(float(np.average(np.arange(WIDTH), weights=changed(picture, plate_rgb()).sum(axis=0))))
    assert columns[0] - columns[1] == pytest.approx(0.05 / 2 * focal_px, abs=0.6)


def test_all_slices_get_one_scene(files: Path, tmp_path_factory: pytest.TempPathFactory) -> None:
    stack = tmp_path_factory.mktemp("stack")
    for index in range(2):
        write_image(stack / f"{index}.exr", plate_rgb())
    camera = Camera(WIDTH, HEIGHT, (LENS.focal_px(WIDTH),) * 2, (WIDTH / 2, HEIGHT / 2))
    plane = np.ones((HEIGHT, WIDTH), np.float32)
    write_merged(stack, plate_rgb(), plane, plane, 2 * plane)
    slices = tuple(Slice(f"{index}.exr", distance_m) for index, distance_m in enumerate((1.3, 6.0)))
    write_focal_stack(replace(FocalStack(stack, slices, LENS, camera, registered=True), merged=True))
    out = files / "stack_with_card"
    words = (stack, "--all-slices", "--layer", files / "card.exr", "--out", out)
    printed_by(app, *words)
    made = read_focal_stack(out)
    sharp, blurred = (made.slice_rgb(index)[50].mean(axis=1) for index in range(2))
    assert np.abs(np.diff(sharp)).max() > 0.5 > np.abs(np.diff(blurred)).max(), "sharp where it is in focus"
    assert made.depth_m()[50, 70] == pytest.approx(1.3, rel=1e-3) and made.depth_m()[5, 5] == pytest.approx(2.0, rel=1e-3)


def test_spaces_of_opencolorio_come_in_and_go_out(files: Path) -> None:
    """Grey is grey in ACEScg too; red of Rec.709 is 0.6131 of red there (AP1 from Rec.709, ACES documents)."""
    pytest.importorskip("PyOpenColorIO")
    write_image(files / "red.exr", np.full((HEIGHT, WIDTH, 3), [1.0, 0.0, 0.0], np.float32), half=False)
    out = put_in(files, "--output-space", "ACEScg", photo="red.exr")
    (written,) = (path for path in files.glob("out*.exr"))
    assert read_exr(written)[0].stacked("RGB")[5, 5, 0] == pytest.approx(0.6131, abs=2e-3)
    np.testing.assert_allclose(out[5, 5], [1.0, 0.0, 0.0], atol=2e-3)  # its header says what it is
    back = put_in(files, "--input-space", "ACEScg", photo="red.exr")
    assert back[5, 5, 0] == pytest.approx(1.705, abs=5e-3) and back[5, 5, 1] < -0.1


def test_the_focus_may_be_told_by_a_pixel(files: Path) -> None:
    depth = ("--depth", files / "depth.exr")
    np.testing.assert_array_equal(put_in(files, *depth, "--focus-at", "10,10"), put_in(files, *depth, "--focus", 0.8))
    refused("there is no depth", put_in, files, "--focus-at", "10,10")
    refused("not both", put_in, files, *depth, "--focus-at", "10,10", "--focus", 0.8)


def test_an_object_beside_the_frame_is_a_mistake_and_an_empty_layer_is_none(files: Path) -> None:
    refused("by --at 9,0,1 it stands beside the frame", put_in, files, "--object", CAKE, "--at", "9,0,1", card=None)
    assert not list(files.glob("out*"))
    write_layer(files / "empty.exr", Layer(np.zeros((HEIGHT, WIDTH, 3), np.float32), *np.zeros((2, HEIGHT, WIDTH), np.float32)))
    np.testing.assert_allclose(put_in(files, card="empty.exr"), plate_rgb(), atol=2e-3)


@pytest.mark.slow
def test_what_is_told_of_a_phones_lens_is_no_f_number(shared_data: Path, tmp_path: Path) -> None:
    words = ("--object", CAKE, "--at-pixel", "380,700", "--height", "200px", "--out", tmp_path / "out.png")
    done = mrbokeh("composite", shared_data / "rgbd" / "phone_lens_blur_gdepth.jpg", *words)
    assert done.returncode == 0 and "the phone's own blur, focused at" in done.stdout and "f/" not in done.stdout, done.stderr


def test_metres_of_depth_without_a_unit_are_doubted(shared_data: Path, tmp_path: Path) -> None:
    """Lens Blur's depth has no unit."""
    path = shared_data / "rgbd" / "phone_lens_blur_gdepth.jpg"
    assert open_plate(path).metres_guessed
    told = plate_by(CompositeOptions(path, PlateOptions(disparity="0.5:4")), None, lens=None, focus_m=None)
    assert not told.metres_guessed
    words = ("--object", CAKE, "--at-pixel", "380,700", "--height", "0.1", "--mode", "front", "--shadow", 0, "--out", tmp_path / "out.png")
    assert "--height 0.1 counts metres, but those of the photograph's depth are guessed" in mrbokeh("composite", path, *words).stderr


def test_glass_is_no_speck() -> None:
    """Half a pixel is told, and 400 pixels that let 70 % of the light through are not."""
    alpha = np.zeros((HEIGHT, WIDTH), np.float32)
    alpha[20:40, 20:40] = 0.3
    speck = np.zeros_like(alpha)
    speck[20, 20] = 0.6
    black, far = np.zeros((HEIGHT, WIDTH, 3), np.float32), np.float32(np.inf)
    layers = [Layer(black, each, np.where(each > 0, np.float32(1.0), far)) for each in (alpha, speck)]
    assert placing_warning(layers[:1], "0.1") is None
    assert "smaller than a pixel" in str(placing_warning(layers[1:], "0.1"))


def test_panoramas_are_refused_or_told(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    plain = cv2.imencode(".jpg", np.full((100, 300, 3), 90, np.uint8))[1].tobytes()
    (tmp_path / "wide.jpg").write_bytes(plain)
    open_plate(tmp_path / "wide.jpg", focus_m=1.0, guessing=True)
    assert "300x100 px is shaped as a panorama" in caplog.text
    packet = b"http://ns.adobe.com/xap/1.0/\0" + (
        b'<x:xmpmeta xmlns:x="adobe:ns:meta/"><rdf:RDF xmlns:rdf="http://www.w3.org/1999/02/22-rdf-syntax-ns#"><rdf:Description '
        b'xmlns:GPano="http://ns.google.com/photos/1.0/panorama/" GPano:ProjectionType="equirectangular"/></rdf:RDF></x:xmpmeta>'
    )
    (tmp_path / "gpano.jpg").write_bytes(plain[:2] + b"\xff\xe1" + (len(packet) + 2).to_bytes(2, "big") + packet + plain[2:])
    refused("is a panorama, as its XMP tells", open_plate, tmp_path / "gpano.jpg", focus_m=1.0, guessing=True)
    assert open_plate(tmp_path / "gpano.jpg", lens=LENS).lens == LENS, "which somebody states"


def test_an_object_in_a_black_and_white_photograph_has_no_colours(tmp_path: Path) -> None:
    grey = np.repeat(np.linspace(0.1, 0.6, 96 * 64, dtype=np.float32).reshape(64, 96, 1), 3, axis=2)
    write_image(tmp_path / "grey.png", grey)
    write_lens(tmp_path / "lens.json", Lens(35.0, 8.0, 1.5, 36.0))
    words = (tmp_path / "grey.png", "--lens", tmp_path / "lens.json", "--object", CAKE, "--at", "0,0.3,1.5", "--height", "0.4")
    for name, more in (("grey", ()), ("plain", ("--plain",))):
        done = mrbokeh("composite", *words, *more, "--out", tmp_path / f"{name}_out.png")
        assert done.returncode == 0, done.stderr
        assert ("black and white" in done.stdout) == (name == "grey")
        assert "_out.png (before everything; 35 mm f/8" in done.stdout
    apart = {name: np.ptp(cv2.imread(str(tmp_path / f"{name}_out.png")), axis=2).max() for name in ("grey", "plain")}
    assert apart["grey"] <= 1 and apart["plain"] > 20


def test_a_matte_that_cannot_be_meant_is_told(files: Path) -> None:
    """One that hides all is warned of, and one that the mode does not look at is refused before anything is read."""
    write_image(files / "white.png", np.ones((96, 144, 3), np.float32), "linear")
    words = (
        files / "photo.exr",
        "--lens",
        files / "lens.json",
        "--object",
        CAKE,
        "--at",
        "0,0.15,1.5",
        "--matte",
        files / "white.png",
        "--shadow",
        0,
    )
    done = mrbokeh("composite", *words, "--out", files / "hidden.exr")
    assert done.returncode == 0 and "all of it lies behind what the matte shows" in done.stderr, done.stderr
    for mode in ("front", "matte"):
        done = mrbokeh("composite", *words, "--mode", mode, "--out", files / f"{mode}.exr")
        assert done.returncode == 2 and f"the mode {mode} does not look at" in done.stderr and len(done.stderr.splitlines()) == 1


@pytest.mark.parametrize(("more", "told"), [
    (("--f-number", -2), "--f-number: expected a number above 0, such as 2.8, got -2"),
    (("--sensor-width", 23500), "--sensor-width: expected millimetres above 0 and up to 500, such as 36, got 23500"),
    (("--focal-length", "nan"), "--focal-length: expected millimetres above 0 and up to 10000, such as 50, got nan"),
    (("--paths", 0), "'--paths': expected at least 1, got '0'"),
    (("--shadow", 3), "'--shadow': expected at most 1, got '3'"),
    (("--sun", "900,400"), "an azimuth of -360 to 360 to the right of the view and an elevation above 0 and up to 90"),
    (("--to-slice", 3), "No such option: --to-slice (Possible options: --all-slices, --slice): see"),
    (("--depth", CAKE), "expected an EXR with Z, a PNG or TIFF, an array (.npz), a phone's photograph (.jpg, .heic) or a depth network"),
])  # fmt: skip
def test_a_value_that_nobody_means_is_refused_in_words_of_the_option(
    files: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, more: tuple[object, ...], told: str
) -> None:
    words = (files / "photo.exr", "--object", CAKE, "--at-pixel", "70,60", *more, "--out", files / "refused.png")
    code, refused_by = said(capsys, monkeypatch, "composite", *words)
    assert code == 2 and told in refused_by, refused_by


def test_a_file_that_is_no_photograph_is_told_what_is_one(tmp_path: Path) -> None:
    (tmp_path / "run.sh").write_text("echo")
    refused(r"run\.sh: expected a photograph, RAW \(such as \.dng, .* or one of \.exr, .*, not \.sh", open_plate, tmp_path / "run.sh", None)
