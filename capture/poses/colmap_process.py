"""COLMAP in a process of its own: some of its errors abort the interpreter, and those must reach the user as one sentence."""

import json
import os
import signal
import sqlite3
import subprocess
import sys
from collections.abc import Iterator
from contextlib import closing, contextmanager
from importlib.util import find_spec
from pathlib import Path
from threading import Event, Thread
from typing import IO, Any

from rich.progress import Progress

import capture
from mrbokeh.system.console import progress_bars
from mrbokeh.system.errors import InputError, MissingExtraError

LOG_NAME = "colmap.log"
DATABASE_NAME = "database.db"

_WORKER = "capture.poses.colmap_worker"
_STAGES = ("features", "matches", "poses")
_LOOK_EVERY_S = 0.5


def run_colmap(folder: Path, pictures: int) -> dict[str, Any] | None:
    """Run the job in `folder`; returns None, or where no model was found what COLMAP saw in the matches.

    Raises MissingExtraError without pycolmap, InputError where the process dies; its output is in colmap.log.
    """
    if find_spec("pycolmap") is None:
        raise MissingExtraError("pycolmap", "capture")
    with (folder / LOG_NAME).open("w", encoding="utf-8") as log, progress_bars() as bars, _worker(folder, log) as process:
        with _features_shown(folder, pictures, bars):
            last = _follow(process, bars)
        status = process.wait()
    if status != 0 or not last:
        raise InputError(_death(folder, status, last))
    failure: dict[str, Any] | None = last.get("failure")
    return failure


@contextmanager
def _worker(folder: Path, log: IO[str]) -> Iterator["subprocess.Popen[str]"]:
    """The process, ended with the block however the block ends."""
    root = str(Path(capture.__file__).parent.parent)
    path = os.pathsep.join(each for each in (root, os.environ.get("PYTHONPATH", "")) if each)
    command = [sys.executable, "-m", _WORKER, str(folder)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=log, text=True, env=os.environ | {"PYTHONPATH": path}) as process:
        try:
            yield process
        finally:
            if process.poll() is None:
                process.terminate()


def _follow(process: "subprocess.Popen[str]", bars: Progress) -> dict[str, Any]:
    """Show what the worker tells; returns the last that it told."""
    tasks, last = {}, {}
    assert process.stdout is not None
    for line in process.stdout:
        if not line.startswith("{"):
            continue
        last = json.loads(line)
        stage = last.get("stage")
        if stage in _STAGES:
            if stage not in tasks:
                tasks[stage] = bars.add_task(f"COLMAP: {stage}", total=last["total"])
            bars.update(tasks[stage], completed=last["done"], total=last["total"])
    return last


@contextmanager
def _features_shown(folder: Path, pictures: int, bars: Progress) -> Iterator[None]:
    """COLMAP does not tell how far its features are, but its database can be asked."""
    if bars.disable:
        yield
        return
    task, over = bars.add_task("COLMAP: features", total=pictures), Event()

    def look() -> None:
        while not over.wait(_LOOK_EVERY_S):
            bars.update(task, completed=_count_features(folder / DATABASE_NAME))

    watcher = Thread(target=look, daemon=True)
    watcher.start()
    try:
        yield
    finally:
        over.set()
        watcher.join()


def _count_features(database: Path) -> int:
    try:
        with closing(sqlite3.connect(f"file:{database}?mode=ro", uri=True, timeout=0.2)) as connection:
            return int(connection.execute("SELECT COUNT(*) FROM keypoints").fetchone()[0])
    except sqlite3.Error:
        return 0


def _death(folder: Path, status: int, last: dict[str, Any]) -> str:
    how = signal.Signals(-status).name if status < 0 else f"status {status}"
    during = {"matches": "matching", "poses": "finding poses"}.get(str(last.get("stage")), "finding features")
    lines = [line for line in (folder / LOG_NAME).read_text(encoding="utf-8", errors="replace").splitlines() if line.strip()]
    errors = [line for line in lines if line[:1] in "EF" and line[1:9].isdigit()] or lines
    told = f" ({errors[-1].strip()[:200]})" if errors else ""
    return (
        f"COLMAP stopped with {how} while {during}{told}: see {folder / LOG_NAME}; give --overwrite to start from the pictures, "
        f"--max-image-size to use less memory"
    )
