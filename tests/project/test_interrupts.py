"""Ctrl-C in the long commands: one line says what is kept and how to go on, and the code is 130."""

from importlib import import_module
from pathlib import Path
from unittest.mock import Mock

import numpy as np
import pytest

from capture.tether.focus_plan import FocusRange, plan_focus, write_plan
from capture.tether.simulated_camera import SimulatedCamera
from mrbokeh.optics.lens import Lens
from tests.support.command_line import mrbokeh
from tests.support.video_files import filmed

WORK = {
    "ingest": ("capture.stacks.ingest.ingest", "{0} --out {0}/scene", "finished slices are kept in {0}/scene"),
    "merge": ("capture.merging.merge.merge_scene", "{0}", "finished stacks are kept in {0}"),
    "poses": ("capture.poses.colmap.find_scene_poses", "{0}", "COLMAP's finished stages are kept in {0}/reconstruction"),
    "depth": ("capture.dense.scene_depth.deepen_scene", "{0}", "finished stacks are kept in {0}"),
    "report": ("capture.report.scene_report.report_scene", "{0}", "what was found of finished stacks is kept in {0}"),
    "dataset": ("capture.dataset.writer.write_dataset", "{0} --out {0}/set --licence CC0", "finished stacks are kept in {0}/set"),
    "matchmove": (
        "capture.matchmove.clip_matchmove.matchmove_clip", "{0}/clip.mkv --out {0}/track.json",
        "keyframes and what was solved, as far as it is finished, are kept in {0}/track_matchmove",
    ),
}  # fmt: skip


@pytest.mark.parametrize("command", WORK)
def test_what_is_kept_and_how_to_go_on(command: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    work, arguments, kept = WORK[command]
    module, _, name = work.rpartition(".")
    monkeypatch.setattr(import_module(module), name, Mock(side_effect=KeyboardInterrupt))
    filmed(tmp_path / "clip.mkv", [np.zeros((24, 32, 3), np.float32)])
    given = ["capture", command, *arguments.format(tmp_path).split()]
    goes_on, again = "the same command goes on from there", "with --overwrite it begins again"
    for more, told in (([], goes_on), (["--overwrite"], goes_on if command == "matchmove" else again)):
        done = mrbokeh(*given, *more)
        assert (done.returncode, done.stderr) == (130, f"stopped: {kept.format(tmp_path)}; {told}\n")


def test_a_camera_is_let_go_when_a_shoot_is_stopped(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write_plan(tmp_path / "plan.json", plan_focus(Lens(50.0, 2.0, 1.0, 36.0), FocusRange(0.8, 3.0), 100))
    closing = Mock()
    monkeypatch.setattr(SimulatedCamera, "close", closing)
    monkeypatch.setattr(SimulatedCamera, "capture", Mock(side_effect=KeyboardInterrupt))
    plan, out = tmp_path / "plan.json", tmp_path / "view_0"
    done = mrbokeh("capture", "shoot", "--plan", plan, "--source", "simulated", "--out", out, "--settle", "0")
    assert done.returncode == 130 and closing.call_count == 1
    # On a busy machine a line of progress comes before it.
    assert done.stderr.endswith(f"stopped: what was shot is kept in {out}; the same command goes on from there\n")
