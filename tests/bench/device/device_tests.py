"""Tests of what runs on a device, by pytest in a process of its own with MRBOKEH_TEST_DEVICE set; a row for each file."""

import os
import re
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Iterator
from importlib.util import find_spec
from pathlib import Path
from tempfile import TemporaryDirectory

from tests.bench.device.rows import Row, Run
from tests.support.torch_device import VARIABLE

ROOT = Path(__file__).resolve().parents[3]
FILES = (
    "tests/renderers/test_torch_polygon.py",
    "tests/depth/test_plane_sweep_torch.py",
    "tests/renderers/test_torch_spreadlets.py",
    "tests/psf_models/test_torch_tracing.py",
    "tests/renderers/test_torch_reconstruction.py",
)
OUTCOME = re.compile(r"(?:(?P<before>PASSED|FAILED|ERROR|SKIPPED|XFAIL|XPASS) )?(?P<file>tests/[\w/]+\.py)::(?P<test>.*)")
"""A line of `pytest -v`: the outcome stands behind the test, or before it where several workers run."""
MOST_WORKERS = 6
ALONE = ("--no-header", "-p", "no:cacheprovider", "-v", "--tb=short", "-rfE", "-m", "not slow")
OWN_SETTINGS = ("-o", "addopts=--strict-markers", "-o", "filterwarnings=default")
"""Warnings of other versions than those of constraints.txt hide no outcome."""


def rows(run: Run) -> Iterator[Row]:
    if find_spec("pytest") is None:
        run.tell("  pytest is missing: no tests")
        return
    with TemporaryDirectory() as folder:
        written = Path(folder) / "pytest.txt"
        begun_s = time.monotonic()
        is_late = _run_pytest(run, written)
        text, took_s = written.read_text(encoding="utf-8", errors="replace"), time.monotonic() - begun_s
    outcomes = outcomes_of(text)
    for file in FILES:
        mine = outcomes.get(file, Counter())
        words = ", ".join(f"{number} {name.lower()}" for name, number in mine.items()) or "nothing was run"
        yield Row(file, f"{sum(mine.values())} tests", note=words)
    last = text.strip().splitlines()[-1:] or ["no output"]
    late = "stopped because the time was up; " if is_late else ""
    yield Row(f"pytest, {VARIABLE}={run.device.type}", f"{took_s:.0f} s", note=f"{late}{last[0].strip('= ')}")
    failures = failures_of(text)
    for name, why in failures:
        yield Row(name, note=why)
    assert not failures, f"{len(failures)} tests failed"


def _run_pytest(run: Run, written: Path) -> bool:
    """Run all files; return whether the time was up before they were done."""
    workers = min(MOST_WORKERS, run.cores // 2)
    several = ("-n", str(workers), "--dist", "worksteal") if find_spec("xdist") and workers > 1 else ()
    run.tell(f"  {len(FILES)} files, {workers if several else 1} at a time")
    command = [sys.executable, "-m", "pytest", *ALONE, *OWN_SETTINGS, *several, *FILES]
    environment = {**os.environ, VARIABLE: run.device.type, "OMP_NUM_THREADS": "1"}
    with written.open("w", encoding="utf-8") as file:
        running = subprocess.Popen(command, cwd=ROOT, stdout=file, stderr=subprocess.STDOUT, env=environment)
        try:
            running.wait(timeout=max(1.0, run.left_s - 3.0))
        except subprocess.TimeoutExpired:
            return True
        finally:
            _end(running)
    return False


def _end(running: subprocess.Popen[bytes]) -> None:
    """End the process if it still runs; pytest ends its workers."""
    if running.poll() is None:
        running.terminate()
        try:
            running.wait(timeout=2.0)
        except subprocess.TimeoutExpired:
            running.kill()


def outcomes_of(text: str) -> dict[str, Counter[str]]:
    """Return how many tests of each file had which outcome."""
    found: dict[str, Counter[str]] = {}
    for line in text.partition("= short test summary")[0].splitlines():
        if match := OUTCOME.search(line):
            behind = re.search(r" (PASSED|FAILED|ERROR|SKIPPED|XFAIL|XPASS)\b", match["test"])
            if word := match["before"] or (behind and behind[1]):
                found.setdefault(match["file"], Counter())[word] += 1
    return found


def failures_of(text: str) -> list[tuple[str, str]]:
    """Return the tests that failed, and the end of what pytest says of each."""
    summary = text.partition("= short test summary")[2].splitlines()
    split = [line.split(" ", 1)[1].partition(" - ") for line in summary if line.startswith(("FAILED ", "ERROR "))]
    return [(f"failed: {name}", why[:300]) for name, _, why in split]
