"""Two processes, started by torchrun and talking over gloo, learn what one learns from the same pictures."""

import dataclasses
import os
import socket
import subprocess
import sys
from pathlib import Path

import pytest
import torch

from tests.training.test_train import DEMO_LIKE, make_wall
from training.data.training_data import training_data
from training.fitting import train
from training.fitting.distributed import Ranks
from training.fitting.run_folder import build_network, load_run
from training.fitting.settings import TrainSettings

ROOT = Path(__file__).resolve().parents[2]
TWO = dataclasses.replace(DEMO_LIKE, epochs=2, batch=1, device="cpu", crop_px=32, sheets=False)


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return make_wall(tmp_path_factory.mktemp("distributed") / "wall")


def torchrun(*arguments: str, start: tuple[str, ...] = ("-m", "training")) -> subprocess.Popen[str]:
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    command = [sys.executable, "-m", "torch.distributed.run", "--nproc-per-node", "2", "--master-addr", "127.0.0.1"]
    command += ["--master-port", str(port), *start, "fit", *arguments]
    environment = os.environ | {"PYTHONPATH": str(ROOT), "OMP_WAIT_POLICY": "PASSIVE", "GLOO_SOCKET_IFNAME": "lo"}
    return subprocess.Popen(command, env=environment, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)


def arguments(scene: Path, out: Path, settings: TrainSettings) -> list[str]:
    train.write_settings(out.parent / f"{out.name}_settings", settings)
    file = out.parent / f"{out.name}_settings" / "settings.json"
    return [str(scene), "--settings", str(file), "--held-out", "view_2", "--out", str(out)]


def largest_difference(a: dict[str, torch.Tensor], b: dict[str, torch.Tensor]) -> float:
    return max(float((a[name] - b[name]).abs().max()) for name in a)


@pytest.mark.slow
def test_two_processes_learn_what_one_with_twice_the_batch_learns(scene: Path, tmp_path: Path) -> None:
    """Gradients are sums over pictures, whoever computes them: the same weights but for the order of these sums."""
    process = torchrun(*arguments(scene, tmp_path / "two", TWO))
    said, errors = process.communicate(timeout=120)
    assert process.returncode == 0, errors
    assert said.count("6 steps") == 1  # 2 epochs of 6 pairs, 2 at a time; one process says so
    train.fit(training_data([scene]), tmp_path / "one", dataclasses.replace(TWO, batch=2), ["view_2"])
    assert largest_difference(*(load_run(tmp_path / name)[0].state_dict() for name in ("one", "two"))) < 1e-6
    learnt, settings, facts = load_run(tmp_path / "one")
    before = build_network(settings, facts).state_dict()
    assert largest_difference(learnt.state_dict(), before) > 1e-3


# The command, but the second process is asked to stop as its 6th step begins.
STOPPED_SECOND = """
import os, signal, sys
from mrbokeh.cli import main
from training.fitting.run import Run

step = Run._step
def stopped(run, rate_factor):
    if os.environ["RANK"] == "1" and run.progress.step == 5:
        signal.raise_signal(signal.SIGTERM)
    step(run, rate_factor)
Run._step = stopped
sys.argv.insert(1, "train")
main()
"""


@pytest.mark.slow
def test_one_process_asked_to_stop_stops_all_and_one_alone_goes_on(scene: Path, tmp_path: Path) -> None:
    """The second process never writes; the first leaves a checkpoint of the same step. Another number of processes goes through the
    pictures that are left: 8 epochs of 6 pairs are 48 pictures, of which 6 steps of two have shown 12."""
    settings = dataclasses.replace(TWO, epochs=8, checkpoint_every_s=1e6)
    (tmp_path / "stopped.py").write_text(STOPPED_SECOND)
    process = torchrun(*arguments(scene, tmp_path / "run", settings), start=(str(tmp_path / "stopped.py"),))
    _, errors = process.communicate(timeout=120)
    assert process.returncode != 0 and errors.count("go on") == 1, errors
    assert str(ROOT / "training") not in errors  # no traceback of ours
    saved = torch.load(tmp_path / "run" / "checkpoint.pt", weights_only=True)["progress"]
    assert (saved["step"], saved["pictures"]) == (6, 12)
    progress = train.fit(training_data([scene]), tmp_path / "run", settings, ["view_2"])
    assert progress.finished and (progress.step, progress.pictures) == (6 + 36, 48)


@pytest.mark.slow
def test_a_mistake_is_told_once(tmp_path: Path) -> None:
    process = torchrun(*arguments(tmp_path / "nowhere", tmp_path / "run", TWO))
    _, errors = process.communicate(timeout=60)
    assert process.returncode != 0 and errors.count("error: ") == 1


def test_a_process_alone_keeps_its_gradients() -> None:
    layer = torch.nn.Linear(2, 1)
    layer(torch.ones(1, 2)).sum().backward()
    assert Ranks(torch.device("cpu")).average_gradients(layer, [1.5, 2.0]) == [1.5, 2.0]
    assert layer.weight.grad is not None and layer.weight.grad.tolist() == [[1.0, 1.0]]
