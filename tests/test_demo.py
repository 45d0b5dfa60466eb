"""The machinery of the demo on small commands; the demo itself is the slow test at the end."""

import json
import os
import re
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from rich.console import Console

from mrbokeh.demo.plan import demo_stages
from mrbokeh.demo.stages import Stage, run_stages
from mrbokeh.errors import InputError


def lens_stage(path: Path, focus_m: float = 1.0) -> Stage:
    arguments = ("lens", "new", str(path), "--focal-length", "50", "--f-number", "2", "--focus", f"{focus_m:g}", "--overwrite")
    return Stage("lens", "Write a lens", arguments, (path,))


def draw_stage(lens: Path, picture: Path) -> Stage:
    return Stage("draw", "Draw it", ("lens", "show", str(lens), "--out", str(picture)), (picture,), when_stale=("--overwrite",))


def test_finished_stages_are_skipped_and_stale_ones_are_not(tmp_path: Path) -> None:
    lens, picture, console = tmp_path / "lens.json", tmp_path / "lens.png", Console(quiet=True)
    first = run_stages([lens_stage(lens), draw_stage(lens, picture)], tmp_path, console)
    assert [done.skipped for done in first] == [False, False]
    again = run_stages([lens_stage(lens), draw_stage(lens, picture)], tmp_path, console)
    assert [done.skipped for done in again] == [True, True]
    assert again[0].seconds == pytest.approx(first[0].seconds), "the report keeps the time of the run that did the work"
    drawn = picture.stat().st_mtime_ns
    changed = run_stages([lens_stage(lens, focus_m=2.0), draw_stage(lens, picture)], tmp_path, console)
    assert [done.skipped for done in changed] == [False, False]
    assert picture.stat().st_mtime_ns > drawn


def test_a_lost_output_is_made_again(tmp_path: Path) -> None:
    lens, console = tmp_path / "lens.json", Console(quiet=True)
    run_stages([lens_stage(lens)], tmp_path, console)
    lens.unlink()
    assert not run_stages([lens_stage(lens)], tmp_path, console)[0].skipped
    assert lens.exists()


def test_a_failing_stage_names_its_command(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="mrbokeh lens show"):
        run_stages([draw_stage(tmp_path / "none.json", tmp_path / "a.png")], tmp_path, Console(quiet=True))


def test_every_stage_of_the_plan_names_its_outputs(tmp_path: Path) -> None:
    stages = demo_stages(tmp_path, 1.0)
    assert len({stage.name for stage in stages}) == len(stages)
    assert all(stage.outputs and str(tmp_path) in stage.command_line for stage in stages)
    commands = {stage.arguments[:2] for stage in stages}
    assert {("capture", "ingest"), ("capture", "merge"), ("train", "fit"), ("train", "export"), ("train", "evaluate")} <= commands


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
    assert first.wait(timeout=60) != 0
    assert not (tmp_path / "report.html").exists()
    subprocess.run(command, check=True)
    page = (tmp_path / "report.html").read_text()
    assert all((tmp_path / source).is_file() for source in re.findall(r'<img src="([^"]+)"', page))
    missed = [number for number in json.loads((tmp_path / "numbers.json").read_text()) if not number["met"]]
    assert not missed
