"""The machinery of the demo on small commands; the demo itself is the slow test at the end."""

import json
import os
import re
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from matplotlib.figure import Figure

from mrbokeh.commands import lens as lens_command
from mrbokeh.demo import stages
from mrbokeh.demo.plan import VIEWS, demo_stages
from mrbokeh.demo.report import (
    camera_measurements,
    depth_error,
    merge_measurements,
    placement_measurement,
    read_truth,
    write_depth_pictures,
)
from mrbokeh.demo.stages import Record, Stage, must_be_anew, read_record, run_stages, write_record
from mrbokeh.images.exr_io import ExrPart, write_exr
from mrbokeh.images.image_io import read_image, write_image, write_layer
from mrbokeh.images.layer import Layer
from mrbokeh.optics.camera import Camera
from mrbokeh.optics.lens_file import read_lens
from mrbokeh.stacks.focal_stack import FocalStack, Slice, write_focal_stack, write_merged
from tests.support.command_line import mrbokeh
from tests.support.refusals import refused


@pytest.fixture(autouse=True)
def commands_run_in_this_process(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    """But in the slow tests: a process takes a second to start."""
    if "slow" not in request.keywords:
        monkeypatch.setattr(stages, "_exit_code", lambda command: mrbokeh(*command[3:]).returncode)


def lens_stage(path: Path, focus_m: float = 1.0) -> Stage:
    arguments = ("lens", "new", str(path), "--focal-length", "50", "--f-number", "2", "--focus", f"{focus_m:g}", "--overwrite")
    return Stage("lens", "Write a lens", arguments, (path,))


@pytest.fixture
def drawn_small(monkeypatch: pytest.MonkeyPatch) -> None:
    """`lens show` draws an empty figure: what it shows is not the subject."""
    monkeypatch.setattr(lens_command, "_drawn_lens", lambda path, _width_px: read_lens(path) and Figure(figsize=(1.0, 1.0)))


def draw_stage(lens: Path, picture: Path) -> Stage:
    return Stage("draw", "Draw it", ("lens", "show", str(lens), "--out", str(picture)), (picture,), when_stale=("--overwrite",))


@pytest.mark.usefixtures("drawn_small")
def test_finished_stages_are_skipped_and_stale_ones_are_not(tmp_path: Path) -> None:
    lens, picture = tmp_path / "lens.json", tmp_path / "lens.png"
    first, again = (run_stages([lens_stage(lens), draw_stage(lens, picture)], tmp_path) for _ in range(2))
    assert [done.skipped for done in first] == [False, False] and [done.skipped for done in again] == [True, True]
    assert again[0].seconds == pytest.approx(first[0].seconds), "the report keeps the time of the run that did the work"
    drawn = picture.stat().st_mtime_ns
    changed = run_stages([lens_stage(lens, focus_m=2.0), draw_stage(lens, picture)], tmp_path)
    assert [done.skipped for done in changed] == [False, False] and picture.stat().st_mtime_ns > drawn
    # A result is stale where its input was made anew by a run that got no further.
    run_stages([lens_stage(lens)], tmp_path)
    later = run_stages([lens_stage(lens), draw_stage(lens, picture)], tmp_path)
    assert [done.skipped for done in later] == [True, False]
    # A lost output is made again.
    lens.unlink()
    assert not run_stages([lens_stage(lens)], tmp_path)[0].skipped and lens.exists()


def test_a_failing_stage_names_its_command(tmp_path: Path) -> None:
    refused("mrbokeh lens show", run_stages, [draw_stage(tmp_path / "none.json", tmp_path / "a.png")], tmp_path)


def test_what_was_interrupted_goes_on_and_what_replaced_something_starts_over(tmp_path: Path) -> None:
    arguments, inputs = ("draw",), {"lens": "run 1"}
    begun = Record("run 2", arguments, inputs)
    assert not must_be_anew(None, arguments, inputs)
    assert not must_be_anew(begun, arguments, inputs), "interrupted in its first run: it goes on"
    assert must_be_anew(begun, arguments, {"lens": "run 3"}), "what it left is of an older input"
    assert must_be_anew(begun, ("draw", "large"), inputs)
    assert must_be_anew(replace(begun, anew=True), arguments, inputs), "it may have left parts of both"
    assert must_be_anew(replace(begun, seconds=1.0), arguments, inputs), "finished, but something was lost"
    write_record(tmp_path / "draw.json", begun)
    assert read_record(tmp_path / "draw.json") == begun


def test_records_of_earlier_versions_hold_for_nothing(tmp_path: Path) -> None:
    (tmp_path / "lens.json").write_text(json.dumps({"arguments": ["lens"], "seconds": 2.0}))
    record = read_record(tmp_path / "lens.json")
    assert record is not None and not record.still_holds(("lens",), {"plan": "run 1"})


@pytest.mark.usefixtures("drawn_small")
def test_the_demo_goes_on_without_an_optional_stage_and_finds_it_later(tmp_path: Path) -> None:
    lens = tmp_path / "found" / "lens.json"
    picture, sheet = tmp_path / "found" / "lens.png", tmp_path / "sheet.png"
    poses = replace(draw_stage(lens, picture), name="poses", when_stale=(), optional=True)
    arguments = ("lens", "show", str(lens), "--out", str(sheet), str(picture.parent))
    depth = Stage("depth", "Needs the poses", arguments, (sheet,), optional=True)
    report = lens_stage(tmp_path / "own.json")
    first, again = (run_stages([poses, depth, report], tmp_path) for _ in range(2))
    assert [done.failed for done in first] == [True, True, False]
    assert [(done.failed, done.skipped) for done in again] == [(True, False), (True, True), (False, True)], "tried again, report stays"
    lens.parent.mkdir()
    run_stages([lens_stage(lens)], tmp_path)
    assert [done.failed for done in run_stages([poses, report], tmp_path)] == [False, False]


def test_every_stage_of_the_plan_names_its_outputs(tmp_path: Path) -> None:
    planned = demo_stages(tmp_path)
    assert len({stage.name for stage in planned}) == len(planned)
    assert all(stage.outputs and str(tmp_path) in stage.command_line for stage in planned)
    capture = {("capture", name) for name in ("ingest", "merge", "poses", "scale", "depth", "report")}
    assert capture | {("train", "fit"), ("train", "export"), ("train", "evaluate")} <= {stage.arguments[:2] for stage in planned}


def test_the_quick_demo_shows_an_object_before_and_after_and_is_not_done_twice(tmp_path: Path) -> None:
    """The first command people try, whole: its page names pictures that exist, and the object changes the photograph where it stands."""
    for again in (False, True):
        done = mrbokeh("demo", "--quick", "--out", tmp_path)
        assert done.returncode == 0 and done.stdout.count("done already") == (4 if again else 0), done.stdout + done.stderr
    page = (tmp_path / "quick.html").read_text()
    pictures = [tmp_path / name for name in re.findall(r'img src="([^"]+)"', page)]
    assert len(pictures) == 6 and all(path.stat().st_size > 0 for path in pictures)
    for before, after in (pictures[:2], pictures[2:4]):
        difference = np.abs(read_image(before) - read_image(after)).sum(axis=2)
        assert difference[200:250, 170:200].mean() > 0.05 and difference[:, 400:].max() < 0.01, "there, and only there"


def test_merging_again_takes_everything_after_it_again(tmp_path: Path) -> None:
    """`merge` overwrites the pictures that `depth` made, so that no later stage may be skipped."""
    planned = {stage.name: stage for stage in demo_stages(tmp_path)}
    fed = {name for name, stage in planned.items() if planned["desk_merge"].feeds(stage)}
    assert {"desk_poses", "desk_scale", "desk_depth", "desk_report", "desk_fit", "desk_evaluate", "desk_cake_sharp_network"} <= fed
    assert not any(name.startswith("board") for name in fed)
    replacing = ("desk_merge", "desk_poses", "desk_scale", "desk_depth", "desk_fit")
    assert all("--overwrite" in planned[name].arguments + planned[name].when_stale for name in replacing)


def stack_at(x_m: float, focal_px: float) -> FocalStack:
    """A stack whose camera was moved to the right."""
    pose = np.eye(4)
    pose[0, 3] = -x_m
    return FocalStack(Path("view"), (), camera=Camera(8, 6, (focal_px, focal_px), (4.0, 3.0), pose))


def test_cameras_too_far_apart_are_found_out() -> None:
    """Placed 1.5 % too far apart, with a focal length 0.4 % too short."""
    true = [stack_at(x_m, 100.0).camera for x_m in (0.0, 0.1, 0.3)]
    scale, focal = camera_measurements([stack_at(0.5 + 1.015 * x_m, 99.6) for x_m in (0.0, 0.1, 0.3)], true)
    assert (scale.text, scale.met) == ("+1.50%", False) and (focal.text, focal.met) == ("-0.40%", True)
    lost = camera_measurements([stack_at(0.0, 100.0)] * 3, true)
    assert [(each.text, each.met) for each in lost] == [("not found", False)]


def test_an_object_beside_its_pixel_is_found_out(tmp_path: Path) -> None:
    """Columns 40 to 59 of 100 are solid, so that the object stands at x = 50; its shadow to the right does not count."""
    alpha = np.zeros((10, 100), np.float32)
    alpha[:, 40:60], alpha[:, 60:90] = 1.0, 0.5
    write_layer(tmp_path / "cake.exr", Layer(np.zeros((10, 100, 3), np.float32), alpha, np.ones((10, 100), np.float32)))
    met, missed = (placement_measurement(tmp_path / "cake.exr", at_pixel) for at_pixel in ("51,5", "53,5"))
    assert (met.text, met.met, missed.text, missed.met) == ("1.0 px", True, "3.0 px", False)


SHAPE = (6, 8)


def write_depth_stack(folder: Path, depth_m: float) -> FocalStack:
    """A grey stack 2 m away whose depth is trusted in its left half and wrong in the other."""
    depth, confidence = np.full(SHAPE, depth_m, np.float32), np.zeros(SHAPE, np.float32)
    depth[:, 4:], confidence[:, :4] = 9.0, 1.0
    grey = np.full((*SHAPE, 3), 0.25, np.float32)
    stack = FocalStack(folder, (Slice("a.exr", 1.0), Slice("b.exr", 3.0)), registered=True, merged=True)
    folder.mkdir(parents=True, exist_ok=True)
    for each in stack.slices:
        write_image(folder / each.path, 0.5 * grey)
    write_merged(folder, grey, np.zeros(SHAPE, np.float32), confidence, depth)
    write_focal_stack(stack)
    return stack


def test_both_passes_are_held_against_the_truth(tmp_path: Path) -> None:
    """2.02 m instead of 2 m from focus alone, 2.002 m afterwards; only where the depth is trusted."""
    stack, truth = write_depth_stack(tmp_path / "view", 2.02), tmp_path / "truth"
    write_image(truth / "all_in_focus.exr", np.full((*SHAPE, 3), 0.375, np.float32))
    write_exr(truth / "depth.exr", ExrPart({"Z": np.full(SHAPE, 2.0, np.float32)}))
    assert depth_error(stack, read_truth(truth)).median == pytest.approx(0.01, rel=1e-4)
    assert "from focus alone" not in merge_measurements(stack.folder, truth)[1].what
    assert write_depth_pictures(stack, read_truth(truth), tmp_path) == []
    write_depth_stack(stack.folder / "first_pass", 2.02)
    write_depth_stack(stack.folder, 2.002)
    picture, depth = merge_measurements(stack.folder, truth)
    assert picture.text == "18.06 dB", "20 log10(1 / 0.125)"
    assert depth.text == "0.10%" and "50% of the picture; from focus alone 1.00% in 50%" in depth.what
    assert all(path.is_file() for path, _ in write_depth_pictures(stack, read_truth(truth), tmp_path))


@pytest.mark.slow
def test_the_demo_reaches_its_numbers_and_survives_an_interruption(tmp_path: Path) -> None:
    """Interrupted in the middle of its training, run again, and then measured against what is wanted."""
    command = [sys.executable, "-m", "mrbokeh.cli", "demo", "--out", str(tmp_path)]
    first = subprocess.Popen(command, start_new_session=True)
    deadline = time.monotonic() + 120
    while not (tmp_path / "desk" / "network" / "settings.json").exists() and time.monotonic() < deadline:
        time.sleep(0.5)
    time.sleep(20)
    os.killpg(first.pid, signal.SIGINT)
    assert first.wait(timeout=60) != 0 and not (tmp_path / "report.html").exists()
    subprocess.run(command, check=True)
    page = (tmp_path / "report.html").read_text()
    assert all((tmp_path / source).is_file() for source in re.findall(r'<(?:img src|a href)="([^"]+)"', page))
    assert all((tmp_path / "desk" / "scene" / view / "first_pass" / "depth.exr").is_file() for view in VIEWS)
    missed = [number for number in json.loads((tmp_path / "numbers.json").read_text()) if not number["met"]]
    assert not missed
