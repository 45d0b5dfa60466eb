"""Photographs that do not belong among the slices of a stack: found in real ones, and no others; and one sentence where nothing belongs."""

import shutil
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest

from capture.photos.developing import develop
from capture.photos.photo_metadata import PhotoMetadata
from capture.photos.sidecar import Sidecar
from capture.stacks.grouping import Grouping, Photo
from capture.stacks.ingest import IngestSettings, ingest
from capture.stacks.slice_looks import look_at, look_of, one_scene, same_photograph
from capture.stacks.stack_ingest import Candidate, blown, duplicates, odd_sizes, other_scenes
from mrbokeh.images.image_io import write_image
from tests.support.made_photographs import Picture, defocused, make_shoot, only_stack, scene_rgb, sources
from tests.support.refusals import refused

CHECKS = (blown, duplicates, other_scenes)


def candidate(path: Path) -> Candidate:
    decoded = develop(path, None, max_width=640)
    return Candidate(Photo(path, PhotoMetadata(), Sidecar()), look_of(decoded))


def sweep(folder: Path, count: int = 5, seed: int = 0) -> Path:
    """PNG of one scene, each blurred by 1 px more than the one before."""
    rgb = np.minimum(scene_rgb(120, 160, seed), 0.6)
    for index in range(count):
        write_image(folder / f"{index}.png", defocused(rgb, index))
    return folder


@pytest.mark.slow
@pytest.mark.parametrize("name", ["keyboard_defocus", "button_macro", "pcb_oblique"])
def test_all_slices_of_a_real_stack_belong(shared_data: Path, name: str) -> None:
    """Strong defocus, 2 % of breathing, drifting exposure."""
    files = sorted(each for each in (shared_data / "stacks" / name).glob("*.jpg") if "fused" not in each.name)
    candidates = [candidate(each) for each in files]
    assert {check.__name__: check(candidates) for check in CHECKS} == {check.__name__: {} for check in CHECKS}
    assert odd_sizes([(each.photo.path.name, each.look.codes.shape) for each in candidates]) == {}


def test_real_strangers_and_copies_are_found(shared_data: Path, tmp_path: Path) -> None:
    """Two photographs of another scene, of the same size, and a copy that was compressed again (quality 90)."""
    own = sorted((shared_data / "stacks" / "keyboard_defocus").glob("*.jpg"))
    other = sorted((shared_data / "stacks" / "usb_two_layers").glob("*.jpg"))
    again = tmp_path / "again.jpg"
    photographed = cv2.imread(str(own[1]))
    assert photographed is not None
    cv2.imwrite(str(again), photographed, [cv2.IMWRITE_JPEG_QUALITY, 90])
    files = [own[0], other[0], *own[1:4], other[9], *own[4:], again]
    candidates = [candidate(each) for each in files]
    assert list(other_scenes(candidates)) == [1, 5]
    assert duplicates(candidates) == {len(files) - 1: f"it is the same photograph as {own[1].name}"}


def test_breathing_tint_exposure_and_blur_are_no_other_scene() -> None:
    """8 % of breathing, blur of a tenth of the width, blue light, a third of the light."""
    rgb = np.minimum(scene_rgb(360, 480, 3), 0.6)
    none_full = np.zeros(rgb.shape[:2], bool)
    breathed = cv2.resize(defocused(rgb, 12.0), None, fx=1.08, fy=1.08)[14:374, 19:499] * np.array([0.2, 0.3, 0.45], np.float32)
    look = look_at(rgb, none_full, None, 0.0)
    assert one_scene(look, look_at(breathed, none_full, None, 0.0))
    assert not one_scene(look, look_at(np.minimum(scene_rgb(360, 480, 4), 0.6), none_full, None, 0.0))


def test_a_hand_that_moves_far_is_no_other_scene(shared_data: Path) -> None:
    """Two slices of a real stack, cut so that they lie a quarter of their width apart: features tell what large areas do not."""
    first, second = (develop(shared_data / "stacks" / "usb_two_layers" / name, None, max_width=640).rgb for name in ("07.jpg", "09.jpg"))
    none_full = np.zeros((first.shape[0], 512), bool)
    looks = [look_at(np.ascontiguousarray(each), none_full, None, 0.0) for each in (first[:, :512], second[:, 128:])]
    assert one_scene(looks[0], looks[1])


def test_neighbours_of_a_fine_sweep_are_two_photographs() -> None:
    """Half a pixel of blur more takes a tenth of the detail; noise of one code out of 255 changes none of it."""
    rng = np.random.default_rng(1)
    rgb = np.minimum(scene_rgb(240, 320, 2), 0.6) * (0.8 + 0.4 * rng.random((240, 320, 1), np.float32))
    none_full = np.zeros(rgb.shape[:2], bool)
    look, blurrier = (look_at(each, none_full, None, 0.0) for each in (defocused(rgb, 1.0), defocused(rgb, 1.5)))
    noisy = look_at(defocused(rgb, 1.0) * (1.0 + 0.004 * rng.standard_normal(rgb.shape, np.float32)), none_full, None, 0.0)
    assert not same_photograph(look, blurrier)
    assert same_photograph(look, noisy)


def test_blown_doubled_and_foreign_slices_are_named_and_left_out(tmp_path: Path) -> None:
    """Also when the first is one of them, which would have given the exposure; --group none takes all of them."""
    shoot = sweep(tmp_path / "shoot")
    write_image(shoot / "00_white.png", np.full((120, 160, 3), 1.2, np.float32))
    write_image(shoot / "6_black.png", np.full((120, 160, 3), 0.0005, np.float32))
    write_image(shoot / "7_foreign.png", np.minimum(scene_rgb(120, 160, 9), 0.6))
    shutil.copy(shoot / "2.png", shoot / "8_copy.png")
    report = ingest([shoot], tmp_path / "scene")
    stack = only_stack(report)
    assert sources(stack) == [f"{index}.png" for index in range(5)]
    assert stack.metadata["exposure_reference"] == "0.png"
    assert [each.metadata["exposure_gain"] for each in stack.slices] == [1.0] * 5
    reasons = {each.path.name: each.reason for each in report.stacks[0].skipped}
    assert reasons["00_white.png"] == "100 % of it is saturated, unlike the rest of its stack"
    assert reasons["6_black.png"] == "it is almost black, unlike the rest of its stack"
    assert reasons["7_foreign.png"].startswith("it shows another scene than most of its stack")
    assert reasons["8_copy.png"] == "it is the same photograph as 2.png"
    assert len(list((stack.folder / "slices").iterdir())) == 5
    everything = ingest([shoot], tmp_path / "all", IngestSettings(Grouping.none))
    assert len(only_stack(everything)) == 9


def test_copies_only_leave_one(tmp_path: Path) -> None:
    shoot = sweep(tmp_path / "shoot", 1)
    for name in ("1.png", "2.png"):
        shutil.copy(shoot / "0.png", shoot / name)
    report = ingest([shoot], tmp_path / "scene")
    assert sources(only_stack(report)) == ["0.png"]
    assert {each.reason for each in report.stacks[0].skipped} == {"it is the same photograph as 0.png"}
    assert any("a stack of 1 slice: merging needs at least 2" in remark for remark in report.stacks[0].remarks)


def two_scenes(folder: Path) -> None:
    write_image(sweep(folder, 1) / "1.png", np.minimum(scene_rgb(120, 160, 5), 0.6))


def two_sizes(folder: Path) -> None:
    write_image(sweep(folder, 1) / "1.png", np.minimum(scene_rgb(100, 160), 0.6))


@pytest.mark.parametrize(
    ("make", "told"),
    [
        (two_scenes, r"shoot: these 2 photographs show different scenes \(0.png is unlike 1.png\): put each stack"),
        (two_sizes, r"no size is the usual one \(0.png 160x120, 1.png 160x100\)"),
    ],
)
def test_without_a_majority_one_sentence_and_nothing_half_written(make: Callable[[Path], None], told: str, tmp_path: Path) -> None:
    make(tmp_path / "shoot")
    refused(told, ingest, [tmp_path / "shoot"], tmp_path / "scene")
    assert not list((tmp_path / "scene").rglob("*.exr"))
    assert not (tmp_path / "scene" / "shoot").exists()
    sweep(tmp_path / "more" / "good", 3)
    shutil.move(tmp_path / "shoot", tmp_path / "more" / "bad")
    reports = {each.name: each for each in ingest([tmp_path / "more"], tmp_path / "other").stacks}
    assert reports["good"].stack is not None, "the other stacks of the call are made"
    assert (reports["bad"].stack, bool(reports["bad"].problem)) == (None, True)


def test_the_only_usable_files_are_never_thrown_away(tmp_path: Path) -> None:
    """The camera that took most has nothing but damaged files."""
    import pyexiv2

    shoot = make_shoot(tmp_path / "shoot")
    for name in ("IMG_8.dng", "IMG_9.dng", "IMG_10.dng"):
        (shoot / name).write_bytes((shoot / name).read_bytes()[:4000])
    for name, model in (("IMG_11.dng", "Another"), ("IMG_12.dng", "A third")):
        with pyexiv2.Image(str(shoot / name)) as image:
            image.modify_exif({"Exif.Image.Model": model})
    report = ingest([shoot], tmp_path / "scene")
    assert sources(only_stack(report)) == ["IMG_12.dng", "IMG_11.dng"]
    assert any("2 photographs of other cameras are taken" in remark for remark in report.stacks[0].remarks)
    assert {each.path.name for each in report.stacks[0].skipped} == {"IMG_8.dng", "IMG_9.dng", "IMG_10.dng"}
    again = ingest([shoot], tmp_path / "scene")
    assert again.stacks[0].kept == 2


def test_mixed_exposure_of_a_real_stack_is_evened_out(shared_data: Path, tmp_path: Path) -> None:
    """Every other slice at 1.6 times its light, clipped at white (8 bits): evened out to 3 %, which is what the stack itself drifts by."""
    files = sorted((shared_data / "stacks" / "usb_two_layers").glob("*.jpg"))[:6:2]
    for index, path in enumerate(files):
        rgb: Picture = develop(path, None, max_width=480).rgb
        write_image(tmp_path / "shoot" / f"{index}.jpg", np.minimum(rgb * np.float32(1.6 if index == 1 else 1.0), 1.0))
    stack = only_stack(ingest([tmp_path / "shoot"], tmp_path / "scene"))
    assert len(stack) == 3
    assert [each.metadata["exposure_gain"] for each in stack.slices] == pytest.approx([1.0, 1 / 1.6, 1.0], rel=0.03)
