"""Runs again and interrupted runs: what is finished is kept, what changed is made again."""

import os
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

import capture.stacks.stack_ingest
import mrbokeh.images.camera_rgb
from capture.cli import app
from capture.stacks.grouping import Grouping
from capture.stacks.ingest import IngestSettings, ingest
from capture.stacks.slice_files import find_slices
from capture.stacks.stack_ingest import Development
from mrbokeh.images.image_io import write_image
from tests.support.made_photographs import make_raw_photo, make_shoot, only_stack, scene_rgb, sources
from tests.support.refusals import refused


@pytest.fixture
def shoot(tmp_path: Path) -> Path:
    return make_shoot(tmp_path / "shoot")


def test_a_rerun_keeps_everything_and_a_merged_stack_too(shoot: Path, tmp_path: Path) -> None:
    from mrbokeh.stacks.focal_stack import write_focal_stack

    stack = only_stack(ingest([shoot], tmp_path / "scene"))
    write_focal_stack(replace(stack, merged=True))
    before = {path: path.stat().st_mtime_ns for path in stack.folder.rglob("*") if path.is_file()}
    report = ingest([shoot], tmp_path / "scene")
    assert report.stacks[0].kept == 5
    assert {path: path.stat().st_mtime_ns for path in stack.folder.rglob("*") if path.is_file()} == before
    assert only_stack(report).merged
    report = ingest([shoot], tmp_path / "scene", IngestSettings(overwrite=True))
    assert report.stacks[0].kept == 0
    assert not only_stack(report).merged
    assert all(path.stat().st_mtime_ns > before[path] for path in (stack.folder / "slices").iterdir())


@pytest.mark.slow
def test_the_whole_way_is_made_again_only_when_asked_to(shoot: Path, tmp_path: Path) -> None:
    scene = tmp_path / "scene"

    def processed(*more: str) -> tuple[str, dict[str, int]]:
        done = CliRunner().invoke(app, ["process", str(shoot), "--out", str(scene), *more], catch_exceptions=False)
        assert done.exit_code == 0, done.output
        return " ".join(done.output.split()), {each.name: each.stat().st_mtime_ns for each in scene.rglob("*.exr")}

    said, first = processed()
    assert "is there already" not in said and {"all_in_focus.exr", "depth.exr", "exclusion.exr", "00.exr"} <= set(first)
    said, again = processed()
    assert "scene is there already: what is finished is kept" in said and "(--overwrite makes all of it again)" in said
    assert again == first
    said, anew = processed("--overwrite")
    assert "is there already" not in said and anew.keys() == first.keys() and all(anew[name] > first[name] for name in first)


def test_only_what_changed_is_made_again(shoot: Path, tmp_path: Path) -> None:
    stack = only_stack(ingest([shoot], tmp_path / "scene"))
    (shoot / "IMG_10.dng").unlink()
    os.utime(shoot / "IMG_8.dng", ns=(1, 1))
    make_raw_photo(shoot / "IMG_7.dng", scene_rgb(72, 96), 0.7)
    report = ingest([shoot], tmp_path / "scene")
    assert report.stacks[0].kept == 3
    assert sources(only_stack(report)) == ["IMG_9.dng", "IMG_7.dng", "IMG_12.dng", "IMG_8.dng", "IMG_11.dng"]
    assert len(list((stack.folder / "slices").iterdir())) == 5, "the slice of the deleted photograph is gone"


def test_an_interrupted_run_goes_on_and_ends_the_same(shoot: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    whole = only_stack(ingest([shoot], tmp_path / "whole"))
    developed: list[str] = []
    real_develop = capture.stacks.stack_ingest.develop

    def counting(path: Path, *args: object, **kwargs: object) -> object:
        if len(developed) == 3:
            raise KeyboardInterrupt
        developed.append(path.name)
        return real_develop(path, *args, **kwargs)  # type: ignore[arg-type]

    with monkeypatch.context() as patch:
        patch.setattr(capture.stacks.stack_ingest, "develop", counting)
        with pytest.raises(KeyboardInterrupt):
            ingest([shoot], tmp_path / "scene")
    assert developed == ["IMG_9.dng", "IMG_10.dng", "IMG_12.dng"]
    assert len(find_slices(tmp_path / "scene" / "shoot")) == 3
    report = ingest([shoot], tmp_path / "scene")
    stack = only_stack(report)
    assert report.stacks[0].kept == 3
    assert (stack.slices, stack.metadata) == (whole.slices, whole.metadata)
    assert all(np.array_equal(stack.slice_rgb(index), whole.slice_rgb(index)) for index in range(5))
    assert not [path for path in stack.folder.rglob("*") if path.name.startswith((".", "made_", "moving_"))]


def opened_slices(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Every slice whose pixels are read from now on, once for each time."""
    opened: list[str] = []
    read = mrbokeh.images.camera_rgb.read_exr
    monkeypatch.setattr(mrbokeh.images.camera_rgb, "read_exr", lambda path: (opened.append(path.name), read(path))[1])
    return opened


@pytest.mark.parametrize(("grouping", "times"), [(Grouping.folder, 1), (Grouping.none, 0)])
def test_kept_slices_are_read_once_or_not_at_all(
    grouping: Grouping, times: int, shoot: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A sixth photograph joins five that are there: whether it belongs is seen in their pixels, but their sizes are on record."""
    settings = IngestSettings(grouping)
    ingest([shoot], tmp_path / "scene", settings)
    make_raw_photo(shoot / "IMG_7.dng", scene_rgb(72, 96), 0.7)
    opened = opened_slices(monkeypatch)
    assert ingest([shoot], tmp_path / "scene", settings).stacks[0].kept == 5
    assert sorted(opened) == sorted(times * [f"{index:02d}.exr" for index in range(5)])


def test_the_stack_that_set_the_exposure_is_read_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Without stated exposure the second stack is brought to the first by what both show."""
    for name, light in (("a", 1.0), ("b", 0.5)):
        write_image(tmp_path / name / "0.png", np.minimum(scene_rgb(96, 128), 0.6) * np.float32(light))
    ingest([tmp_path / "a"], tmp_path / "scene")
    opened = opened_slices(monkeypatch)
    slice_ = only_stack(ingest([tmp_path / "b"], tmp_path / "scene")).slices[0]
    assert slice_.metadata["exposure_gain_session"] == pytest.approx(2.0, rel=0.02) and opened == ["00.exr"]


def test_copies_of_one_photograph_stay_apart(tmp_path: Path) -> None:
    """Same name, size and time in two folders, put into one stack: two slices, also on the next run."""
    path = make_raw_photo(tmp_path / "a" / "0.dng", scene_rgb(24, 32), 0.6)
    (tmp_path / "b").mkdir()
    shutil.copy2(path, tmp_path / "b" / "0.dng")
    folders = [tmp_path / "a", tmp_path / "b"]
    for max_width, overwrite in ((None, False), (None, False), (16, True), (16, False)):
        settings = IngestSettings(grouping=Grouping.none, development=Development(max_width=max_width), overwrite=overwrite)
        assert len(only_stack(ingest(folders, tmp_path / "scene", settings))) == 2


def test_another_size_is_asked_for_by_overwrite_only(tmp_path: Path) -> None:
    """Forgetting --max-width on a later run must not make hours of work anew, nor leave two sizes in a scene."""
    path = make_raw_photo(tmp_path / "shoot" / "0.dng", scene_rgb(24, 32), 0.6)
    small = IngestSettings(development=Development(max_width=16))
    made = only_stack(ingest([path.parent], tmp_path / "scene", small))
    refused("was ingested with --max-width 16, now it is None", ingest, [path.parent], tmp_path / "scene")
    assert made.slice_rgb(0).shape[1] == 16
    again = only_stack(ingest([path.parent], tmp_path / "scene", IngestSettings(overwrite=True)))
    assert again.slice_rgb(0).shape[1] == 32
