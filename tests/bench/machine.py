"""What benchmarks share: how long runs take, in turns, and what they ran on: processor, commit and memory."""

import os
import platform
import resource
import statistics
import subprocess
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import NamedTuple


class Took(NamedTuple):
    """wall_ms: that passed. cpu_ms: of all cores of this process together, which other work on the machine disturbs less."""

    wall_ms: float
    cpu_ms: float


def took(run: Callable[[], object]) -> Took:
    wall_s, cpu_s = time.perf_counter(), time.process_time()
    run()
    return Took(1e3 * (time.perf_counter() - wall_s), 1e3 * (time.process_time() - cpu_s))


def in_turns(*runs: Callable[[], object], repeats: int, of: Callable[[Sequence[float]], float] = statistics.median) -> list[Took]:
    """Medians of each run (or `of`) after a first round that counts for nothing; in turns, so that other work falls on all alike."""
    rounds = [[took(run) for run in runs] for _ in range(repeats + 1)][1:]
    return [Took(*(float(of(each)) for each in zip(*of_run, strict=True))) for of_run in zip(*rounds, strict=True)]


def tell() -> None:
    """Print the last two lines of a benchmark."""
    print(memory_line())
    print(machine_line())


def machine_line() -> str:
    """Processor, cores, Python and commit in one line."""
    return f"{processor_name()}, {os.cpu_count()} cores, Python {platform.python_version()}, commit {_commit()}"


def memory_line() -> str:
    """The largest memory that this process has held."""
    return f"largest memory of the process: {resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024:.0f} MB"


def processor_name() -> str:
    """Return the name of the processor, as Linux knows it."""
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
    except OSError:
        return platform.processor() or platform.machine()
    return next((line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")), platform.machine())


def _commit() -> str:
    root = Path(__file__).resolve().parents[2]
    done = subprocess.run(["git", "describe", "--always", "--dirty"], cwd=root, capture_output=True, text=True)
    return done.stdout.strip() or "unknown"
