"""Shots on a Dask cluster of real processes: a scheduler and workers of their own."""

import json
import os
import signal
import subprocess
import sys
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from mrbokeh import __version__
from mrbokeh.shots.executors import DaskExecutor, Executor, SerialExecutor, require_same_files
from mrbokeh.shots.render_shot import VideoTarget, render_shot
from mrbokeh.system.errors import InputError
from tests.shots.test_shots import COUNT, clip_of_blobs, opened_once_all_work, shot_of
from tests.support.refusals import refused
from tests.support.shot_makers import Brighter, wait_for

distributed = pytest.importorskip("distributed", reason="the extra 'cluster' is not installed")
ROOT = Path(__file__).resolve().parents[2]


@pytest.fixture(scope="module")
def address(tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    """A scheduler and two workers of one thread, each watched by a nanny that starts it again when it dies."""
    told = tmp_path_factory.mktemp("dask") / "scheduler.json"
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "DASK_DISTRIBUTED__WORKER__DAEMON": "True"}
    module, plain = "distributed.cli.dask_", {"cwd": told.parent, "env": environment, "stderr": subprocess.DEVNULL}
    scheduler = [sys.executable, "-m", f"{module}scheduler", "--host", "127.0.0.1", "--port", "0", "--no-dashboard"]
    worker = [sys.executable, "-m", f"{module}worker", "--nworkers", "2", "--nthreads", "1", "--no-dashboard"]
    processes = [subprocess.Popen([*each, "--scheduler-file", str(told)], **plain) for each in (scheduler, worker)]  # type: ignore[call-overload]
    try:
        yield address_in(told)
    finally:
        # Killed, for saying goodbye takes 8 s; workers leave when their nanny is gone.
        for process in reversed(processes):
            process.kill()
        for process in processes:
            process.wait(timeout=30)


def address_in(told: Path) -> str:
    def can_tell() -> bool:
        try:
            return "address" in json.loads(told.read_text(encoding="utf-8"))
        except (OSError, ValueError):
            return False

    wait_for(can_tell)
    address = str(json.loads(told.read_text(encoding="utf-8"))["address"])
    with distributed.Client(address, timeout=60, set_as_default=False) as client:
        client.wait_for_workers(2, timeout=60)
    return address


@pytest.mark.slow
def test_a_cluster_makes_the_same_file(tmp_path: Path, address: str) -> None:
    clip, executor = clip_of_blobs(tmp_path), DaskExecutor(address)
    assert isinstance(executor, Executor)
    render_shot(shot_of(clip, VideoTarget(tmp_path / "one.mp4")), SerialExecutor())
    told: list[int] = []
    recipe = Brighter(gate=tmp_path / "gate", pids=tmp_path / "pids")
    with opened_once_all_work(recipe):
        render_shot(shot_of(clip, VideoTarget(tmp_path / "two.mp4"), recipe), executor, progress=told.append)
    assert len(list((tmp_path / "pids").iterdir())) == 2, "both workers took part"
    assert str(os.getpid()) not in {file.name for file in (tmp_path / "pids").iterdir()}
    assert sum(told) == COUNT
    assert (tmp_path / "two.mp4").read_bytes() == (tmp_path / "one.mp4").read_bytes()
    assert not (tmp_path / "two.mp4.parts").exists()


@pytest.mark.slow
def test_a_worker_killed_while_it_works_loses_nothing(tmp_path: Path, address: str) -> None:
    """One of the two is killed by signal 9 from outside in the middle of its segment; its nanny starts another."""
    clip, pids, gate = clip_of_blobs(tmp_path), tmp_path / "pids", tmp_path / "gate"
    render_shot(shot_of(clip, VideoTarget(tmp_path / "one.mkv")), SerialExecutor())
    pids.mkdir()
    shot = shot_of(clip, VideoTarget(tmp_path / "two.mkv"), Brighter(gate=gate, held_from=2, pids=pids))
    killed: list[int] = []

    def kill_one() -> None:
        # While the gate is shut both have a segment, neither can finish it, and the one of the first has begun to write.
        wait_for(lambda: len(list(pids.iterdir())) == 2 and list(shot.parts_path.glob(".00000.*")))
        (half,) = shot.parts_path.glob(".00000.*")
        killed.append(int(half.name.split(".")[2]))
        assert (pids / str(killed[0])).exists() and not any(shot.parts_path.glob("0*"))
        os.kill(killed[0], signal.SIGKILL)
        gate.touch()

    killer = threading.Thread(target=kill_one, daemon=True)
    killer.start()
    render_shot(shot, DaskExecutor(address))
    killer.join()
    assert killed
    assert (tmp_path / "two.mkv").read_bytes() == (tmp_path / "one.mkv").read_bytes()


@pytest.mark.slow  # in a process of this machine: test_shots
def test_a_mistake_on_a_worker_is_the_users_sentence(tmp_path: Path, address: str) -> None:
    shot = shot_of(clip_of_blobs(tmp_path), VideoTarget(tmp_path / "out.mkv"), Brighter(as_layer=True))
    refused("pictures with alpha need", render_shot, shot, DaskExecutor(address))


def test_nobody_answers() -> None:
    executor = DaskExecutor("tcp://127.0.0.1:9", patience_s=0.5)
    with pytest.raises(InputError, match=r"no Dask scheduler answers at tcp://127\.0\.0\.1:9"), executor._client():
        pass


class Elsewhere:
    """A client whose workers see other disks, or run other versions."""

    def __init__(self, *reports: tuple[bool, bool, str]) -> None:
        self._reports = reports

    def run(self, function: Any, token: str, clip: str) -> dict[str, tuple[str, bool, str]]:
        read, there, version = function(token, clip)
        return {
            f"tcp://there:{i}": (read if sees_token else "", there and sees_clip, other or version)
            for i, (sees_token, sees_clip, other) in enumerate(self._reports)
        }


def test_workers_must_see_the_same_files(tmp_path: Path) -> None:
    clip = clip_of_blobs(tmp_path)
    require_same_files(Elsewhere((True, True, "")), tmp_path, clip)
    for reports, words in (
        ([(True, True, ""), (False, True, "")], "there:1 does not see"),
        ([(True, False, "")], r"does not see .*clip\.mkv: a cluster needs a file system that all machines share"),
        ([(True, True, "0.0.1")], rf"runs mrbokeh 0\.0\.1, but this is {__version__}"),
        ([], "has no workers"),
    ):
        refused(words, require_same_files, Elsewhere(*reports), tmp_path, clip)
    assert [file.name for file in tmp_path.iterdir()] == ["clip.mkv"]
