"""Ctrl-C in the long commands: one line says what is kept and how to go on, and the code is 130."""

import sys
from collections.abc import Callable
from importlib import import_module
from pathlib import Path

import numpy as np
import pytest

from mrbokeh import cli
from mrbokeh.optics.lens import Lens
from mrbokeh.optics.lens_file import write_lens
from mrbokeh.video.writer import VideoWriter

WORK = {
    "ingest": ("capture.stacks.ingest.ingest", ["{0}", "--out", "{0}/scene"], "finished slices are kept in {0}/scene"),
    "merge": ("capture.merging.merge.merge_scene", ["{0}"], "finished stacks are kept in {0}"),
    "poses": ("capture.poses.colmap.find_scene_poses", ["{0}"], "COLMAP's finished stages are kept in {0}/reconstruction"),
    "depth": ("capture.dense.scene_depth.deepen_scene", ["{0}"], "finished stacks are kept in {0}"),
    "report": ("capture.report.scene_report.report_scene", ["{0}"], "what was found of finished stacks is kept in {0}"),
    "dataset": (
        "capture.dataset.writer.write_dataset",
        ["{0}", "--out", "{0}/set", "--licence", "CC0"],
        "finished stacks are kept in {0}/set",
    ),
    "matchmove": (
        "capture.matchmove.clip_matchmove.matchmove_clip",
        ["{0}/clip.mkv", "--out", "{0}/track.json"],
        "keyframes and COLMAP's files, as far as they are finished, are kept in {0}/track_matchmove",
    ),
}


def stopped(*_: object, **__: object) -> None:
    raise KeyboardInterrupt


def said_at(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], *arguments: str) -> tuple[int, str]:
    monkeypatch.setattr(sys, "argv", ["mrbokeh", *arguments])
    with pytest.raises(SystemExit) as stop:
        cli.main()
    return int(stop.value.code or 0), capsys.readouterr().err


@pytest.mark.parametrize("command", WORK)
def test_what_is_kept_and_how_to_go_on(
    command: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    work, arguments, kept = WORK[command]
    module, _, name = work.rpartition(".")
    monkeypatch.setattr(import_module(module), name, stopped)
    with VideoWriter(tmp_path / "clip.mkv", 32, 24) as writer:
        writer.write(np.zeros((24, 32, 3), np.float32), 0.0)
    given = ["capture", command, *(each.format(tmp_path) for each in arguments)]
    code, told = said_at(monkeypatch, capsys, *given)
    assert code == 130 and told == f"stopped: {kept.format(tmp_path)}; the same command goes on from there\n"
    code, told = said_at(monkeypatch, capsys, *given, "--overwrite")
    assert code == 130 and told == f"stopped: {kept.format(tmp_path)}; with --overwrite it begins again\n"


def test_a_camera_is_let_go_when_a_shoot_is_stopped(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    from capture.tether.simulated_camera import SimulatedCamera

    write_lens(tmp_path / "lens.json", Lens(50.0, 2.0, 1.0, 36.0))
    plan = ["--near", "0.8", "--far", "3", "--image-width", "100", "--out", f"{tmp_path}/plan.json"]
    assert said_at(monkeypatch, capsys, "capture", "plan", f"{tmp_path}/lens.json", *plan)[0] == 0
    closed: list[bool] = []
    close: Callable[[SimulatedCamera], None] = SimulatedCamera.close
    monkeypatch.setattr(SimulatedCamera, "close", lambda self: (close(self), closed.append(True)))
    monkeypatch.setattr(SimulatedCamera, "capture", stopped)
    shoot = ["--plan", f"{tmp_path}/plan.json", "--camera", "simulated", "--out", f"{tmp_path}/view_0", "--settle", "0"]
    code, told = said_at(monkeypatch, capsys, "capture", "shoot", *shoot)
    assert code == 130 and closed == [True]
    # On a busy machine a line of progress comes before it.
    assert told.endswith(f"stopped: what was shot is kept in {tmp_path}/view_0; the same command goes on from there\n")
