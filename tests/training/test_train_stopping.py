"""Runs that are killed, asked to stop, or stop of themselves: what is lost, what is kept, and what is written on the way."""

import csv
import dataclasses
import math
import os
import re
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch

from mrbokeh.system.errors import InputError
from tests.support.command_line import mrbokeh, printed_by
from tests.support.drawn_curves import drawn_curves
from tests.support.refusals import refused
from tests.support.waiting import wait_until
from tests.training.test_train import DEMO_LIKE, DEMO_WORDS, make_wall
from training.cli import app
from training.data.training_data import training_data
from training.fitting import train
from training.fitting.checkpoint import CurvePoint, Progress
from training.fitting.record import MOST_KEPT, HeldOutSlices, Look, write_sheet
from training.fitting.run import Interruption, Run
from training.fitting.run_folder import load_run

SHORT = dataclasses.replace(DEMO_LIKE, epochs=4, sheets=False)
ROOT = Path(__file__).resolve().parents[2]

# Notes every step and when it was done, on the clock of the run, as a process that nothing warns of its end.
LOGGED_RUN = """
import sys
from pathlib import Path
from training.fitting import train
from training.fitting.run import Run
from training.fitting.settings import load_settings
from training.data.training_data import training_data

scene, out, log = sys.argv[1:]
step = Run._step
def logged(run, rate_factor):
    step(run, rate_factor)
    with open(log, "a") as file:
        print(run.progress.step, run.progress.elapsed_s, file=file)
Run._step = logged
train.fit(training_data([Path(scene)]), Path(out), load_settings(Path(out) / "settings.json"), ["view_2"])
"""


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return make_wall(tmp_path_factory.mktemp("stopping") / "wall")


def weights(run: Path) -> dict[str, torch.Tensor]:
    return load_run(run)[0].state_dict()


def same(a: dict[str, torch.Tensor], b: dict[str, torch.Tensor]) -> bool:
    return all(torch.equal(a[name], b[name]) for name in a)


def child(*arguments: str) -> subprocess.Popen[str]:
    environment = os.environ | {"PYTHONPATH": str(ROOT), "OMP_WAIT_POLICY": "PASSIVE"}
    return subprocess.Popen(arguments, env=environment, stderr=subprocess.PIPE, stdout=subprocess.PIPE, text=True)


def steps_logged(log: Path) -> int:
    return len(log.read_text().splitlines()) if log.exists() else 0


def test_signals_that_were_ignored_stay_so_and_a_second_one_does_not_wait() -> None:
    """Shells start background jobs with SIGINT ignored: Ctrl-C in the terminal is for the job in front."""
    before = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        with Interruption() as interruption:
            signal.raise_signal(signal.SIGINT)
            assert interruption.asked is None
            signal.raise_signal(signal.SIGTERM)
            assert interruption.asked == signal.SIGTERM
        assert signal.getsignal(signal.SIGINT) is signal.SIG_IGN
    finally:
        signal.signal(signal.SIGINT, before)
    before = signal.getsignal(signal.SIGINT)
    with Interruption() as alone:
        signal.raise_signal(signal.SIGINT)
        assert alone.asked == signal.SIGINT
        with pytest.raises(KeyboardInterrupt):
            signal.raise_signal(signal.SIGINT)
    with Interruption(alone=False) as one_of_many:
        signal.raise_signal(signal.SIGINT)
        signal.raise_signal(signal.SIGINT)
        assert one_of_many.asked == signal.SIGINT
    assert signal.getsignal(signal.SIGINT) is before


@pytest.mark.slow
def test_sigkill_costs_at_most_one_interval_and_the_run_goes_on_to_the_same_weights(scene: Path, tmp_path: Path) -> None:
    """The last checkpoint is at most one interval and two steps (the one that made it due, and the one under way) older than the end."""
    interval_s = 0.05
    settings = dataclasses.replace(SHORT, epochs=16, checkpoint_every_s=interval_s)
    train.write_settings(tmp_path / "killed", settings)
    log = tmp_path / "log"
    process = child(sys.executable, "-c", LOGGED_RUN, str(scene), str(tmp_path / "killed"), str(log))
    checkpoint = tmp_path / "killed" / "checkpoint.pt"
    wait_until(lambda: process.poll() is not None or (checkpoint.exists() and steps_logged(log) >= 12), 90.0)
    process.kill()
    process.communicate()
    assert process.returncode == -signal.SIGKILL
    ends_s = np.array([float(line.split()[1]) for line in log.read_text().splitlines()])
    saved = torch.load(checkpoint, weights_only=True)["progress"]
    longest_s = float(np.diff(ends_s).max())
    assert 0 < saved["step"] <= len(ends_s) < 48
    assert ends_s[-1] - saved["elapsed_s"] <= interval_s + 2.0 * longest_s
    (tmp_path / "killed" / ".checkpoint.1.part.pt").write_bytes(b"half")  # as a kill in the middle of writing leaves it
    train.fit(training_data([scene]), tmp_path / "killed", settings, ["view_2"])
    train.fit(training_data([scene]), tmp_path / "whole", settings, ["view_2"])
    assert same(weights(tmp_path / "killed"), weights(tmp_path / "whole"))
    assert not list((tmp_path / "killed").rglob("*.part*"))


@pytest.mark.slow
def test_sigterm_of_a_batch_system_leaves_a_checkpoint_of_that_very_step(scene: Path, tmp_path: Path) -> None:
    """143 is 128 + SIGTERM. The interval is so long that only the signal can have made the checkpoint."""
    arguments = [str(scene), *DEMO_WORDS, "--epochs", "4000", "--out", str(tmp_path / "run")]
    arguments += ["--set", "checkpoint_every_s=1e6", "--set", "crop_px=0", "--set", "validate_every_s=1e-3"]
    process = child(sys.executable, "-m", "training", "fit", *arguments)
    wait_until(lambda: process.poll() is not None or (tmp_path / "run" / "curve.csv").exists(), 90.0)
    process.terminate()
    _, said = process.communicate(timeout=60)
    assert process.returncode == 143 and "go on" in said
    assert torch.load(tmp_path / "run" / "checkpoint.pt", weights_only=True)["progress"]["step"] > 0


@pytest.mark.parametrize("name", ["old", "new"])
def test_ctrl_c_in_the_first_steps_changes_nothing(name: str, scene: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """While the first steps tell how many there is time for, a finished run is still there, even with --overwrite. 130 is 128 + SIGINT."""
    run, step = tmp_path / name, Run._step
    (tmp_path / "old").mkdir()
    for file in ("settings.json", "network.pt"):
        (tmp_path / "old" / file).write_bytes(b"{}")

    def stopped(run: Run, rate_factor: float) -> None:
        step(run, rate_factor)
        run._stopped_by = signal.SIGINT

    monkeypatch.setattr(Run, "_step", stopped)
    arguments = ["fit", scene, "--preset", "demo", "--minutes", 10, "--threads", 1, "--overwrite", "--out", run]
    done = mrbokeh("train", *arguments)
    assert done.returncode == 130 and f"nothing was changed in {run}" in done.stderr
    assert sorted(path.name for path in tmp_path.rglob("*")) == ["network.pt", "old", "settings.json"]


def looks_of(values: list[float], monkeypatch: pytest.MonkeyPatch) -> list[dict[str, torch.Tensor]]:
    """Let the looks at held-out slices come out like this, the last one from then on; returns what was looked at."""
    seen: list[dict[str, torch.Tensor]] = []

    def look(_: HeldOutSlices, network: torch.nn.Module, _device: torch.device) -> Look:
        seen.append({name: value.clone() for name, value in network.state_dict().items()})
        return Look(values[min(len(seen), len(values)) - 1])

    monkeypatch.setattr(HeldOutSlices, "look", look)
    return seen


@pytest.mark.slow
def test_patience_ends_a_run_and_keeps_the_best_across_an_interruption(
    scene: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A look after each step: the third of 20, 21, 25, 24, 23, 22 dB is the best, three without a better one end the run at step 6."""
    settings = dataclasses.replace(SHORT, epochs=50, patience=3, validate_every_s=1e-9)
    seen = looks_of([20.0, 21.0, 25.0, 24.0, 23.0, 22.0], monkeypatch)
    progress = train.fit(training_data([scene]), tmp_path / "run", settings, ["view_2"])
    assert (progress.step, progress.stopped_early, progress.kept_step, progress.best_psnr_db) == (6, True, 3, 25.0)
    assert len(seen) == 6 and same(weights(tmp_path / "run"), seen[2]) and not same(seen[2], seen[5])
    # Stopped after the fourth look, the third being the best; going on, two more looks use up the patience.
    seen, step, run = looks_of([20.0, 21.0, 25.0, 24.0], monkeypatch), Run._step, tmp_path / "interrupted"

    def interrupted(run: Run, rate_factor: float) -> None:
        step(run, rate_factor)
        if run.progress.step == 4:
            run._stopped_by = signal.SIGTERM

    monkeypatch.setattr(Run, "_step", interrupted)
    with pytest.raises(KeyboardInterrupt):
        train.fit(training_data([scene]), run, settings, ["view_2"])
    monkeypatch.setattr(Run, "_step", step)
    progress = train.fit(training_data([scene]), run, settings, ["view_2"])
    assert (progress.step, progress.kept_step) == (6, 3) and same(weights(run), seen[2])


def test_without_patience_the_last_weights_are_kept_and_patience_needs_looks(
    scene: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    seen = looks_of([30.0, 20.0], monkeypatch)
    progress = train.fit(training_data([scene]), tmp_path / "run", dataclasses.replace(SHORT, validate_every_s=1e-9), ["view_2"])
    assert progress.kept_step == progress.step == 12 and same(weights(tmp_path / "run"), seen[-1])
    assert progress.best_step == 1
    with pytest.raises(InputError, match="patience of 2 looks needs looks"):
        train.fit(training_data([scene]), tmp_path / "blind", dataclasses.replace(SHORT, patience=2), ["view_2"])
    progress = Progress()
    assert not progress.looked(math.nan) and progress.looked(10.0) and not progress.looked(math.nan) and not progress.looked(10.0)
    assert progress.looks_since_best == 2


@pytest.mark.slow
def test_curve_and_sheets_tell_how_it_came_along_in_bounded_room(scene: Path, tmp_path: Path) -> None:
    """12 steps are less than the 200 points of a curve, so each has one; a look after each adds its own, and the last look one more.
    The first picture of the sheets is of step 1, the last of step 12."""
    settings = dataclasses.replace(SHORT, validate_every_s=1e-9, sheets=True)
    with drawn_curves():
        train.fit(training_data([scene]), tmp_path / "run", settings, ["view_2"])
    with (tmp_path / "run" / "curve.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert tuple(rows[0]) == CurvePoint._fields
    looks = [row for row in rows if row["held_out_psnr_db"]]
    assert len(looks) == 13 and {int(row["step"]) for row in rows} == set(range(1, 13))
    assert float(looks[-1]["held_out_psnr_db"]) > float(looks[0]["held_out_psnr_db"])
    assert float(rows[-1]["learning_rate"]) < 0.2 * settings.learning_rate
    sheets = sorted(path.name for path in (tmp_path / "run" / "sheets").iterdir())
    assert sheets[0] == "step_0000001.png" and sheets[-1] == "step_0000012.png"
    assert (tmp_path / "run" / "curve.png").stat().st_size > 0
    # After 100 looks: the first, the last, and no gap between that is more than a third of the run.
    rows = HeldOutSlices(training_data([scene]).stacks[:1]).look(_Sharp(), torch.device("cpu")).rows[:1]
    for step in range(1, 101):
        write_sheet(tmp_path / "many", step, rows)
        steps = sorted(int(path.stem.removeprefix("step_")) for path in (tmp_path / "many" / "sheets").iterdir())
        assert len(steps) <= MOST_KEPT and steps[0] == 1 and steps[-1] == step
    assert max(np.diff(steps)) <= 34


class _Sharp(torch.nn.Module):
    def forward(self, rgb: torch.Tensor, *_: torch.Tensor) -> torch.Tensor:
        return rgb


@pytest.mark.slow
def test_half_precision_learns_the_same(scene: Path, tmp_path: Path) -> None:
    """bfloat16 has 8 bits of mantissa: results differ, by little against what is learnt; weights stay in float32."""
    full, half = (
        train.fit(training_data([scene]), tmp_path / precision, dataclasses.replace(SHORT, epochs=10, precision=precision), ["view_2"])
        for precision in ("float32", "bfloat16")
    )
    first = HeldOutSlices(training_data([scene]).stacks[2:]).look(_Sharp(), torch.device("cpu")).psnr_db
    full_db, half_db = full.curve[-1].held_out_psnr_db, half.curve[-1].held_out_psnr_db
    assert full_db != half_db and abs(full_db - half_db) < 0.2 * (full_db - first)
    assert all(value.dtype == torch.float32 for value in weights(tmp_path / "bfloat16").values())


def test_any_setting_can_be_given_by_its_name(scene: Path, tmp_path: Path) -> None:
    arguments = ["fit", scene, "--preset", "demo", "--held-out", "view_2", "--out", tmp_path / "run", "--seed", 3]
    choices = ["epochs=1", "network.width=1", "crop_px=0", "sheets=false", "sensor_white=none", "loss_weighting=relative", "threads=1"]
    printed_by(app, *arguments, *(part for each in choices for part in ("--set", each)))
    settings = load_run(tmp_path / "run")[1]
    assert (settings.epochs, settings.minutes, settings.network.width, settings.crop_px) == (1, None, 1, 0)
    assert (settings.sheets, settings.sensor_white, settings.loss_weighting, settings.seed) == (False, None, "relative", 3)


@pytest.mark.parametrize(
    ("choice", "message"),
    [
        ("batch=many", "batch takes a whole number, got 'many'"),
        ("batches=4", "no setting 'batches': expected one of batch"),
        ("network.form=fast", "network.form takes one of published, gated"),
        ("learning_rate", "as name=value, got 'learning_rate'"),
        ("sheets=maybe", "sheets takes true or false"),
        ("crop_px=64", "set crop_px to 0, or tile_px to 0"),
    ],
)
def test_settings_that_do_not_exist_or_fit_are_named(choice: str, message: str, tmp_path: Path) -> None:
    refused(re.escape(message), printed_by, app, "fit", tmp_path, "--out", tmp_path / "run", "--set", choice)
