"""What a program costs as a whole: CPU seconds of all cores together, and memory."""

import os
import signal
import subprocess
import sys
from dataclasses import dataclass

_LAUNCHER = """
import resource, subprocess, sys
done = subprocess.run(sys.argv[1:], stdout=sys.stderr)
used = resource.getrusage(resource.RUSAGE_CHILDREN)
print(used.ru_utime + used.ru_stime, used.ru_maxrss)
sys.exit(done.returncode if done.returncode >= 0 else 128 - done.returncode)
"""
_KB_PER_MB = 1024.0  # kilobytes, as Linux states the largest memory of a process


@dataclass(frozen=True)
class Cost:
    """cpu_s: of all cores. memory_mb: the largest of one process. exit_code: 128 and the signal where one ended it. said: all it wrote."""

    cpu_s: float
    memory_mb: float
    exit_code: int
    said: str

    @property
    def last_line(self) -> str:
        return next((line.strip() for line in reversed(self.said.splitlines()) if line.strip()), "")


def mrbokeh(*arguments: object) -> tuple[float, float]:
    """A command of ours in a process of its own, see `measured`."""
    return measured(mrbokeh_command(*arguments))


def mrbokeh_command(*arguments: object) -> list[str]:
    return [sys.executable, "-c", "from mrbokeh.cli import main; main()", *map(str, arguments)]


def measured(command: list[str]) -> tuple[float, float]:
    """(CPU seconds of all cores, largest memory in MB) of a program and those that it starts and waits for."""
    cost = attempted(command)
    if cost.exit_code:
        raise SystemExit(f"{' '.join(command)} failed: {cost.said[-500:]}")
    return cost.cpu_s, cost.memory_mb


def attempted(command: list[str], timeout_s: float | None = None) -> Cost:
    """Run a program that may fail. A small process starts it, because Linux counts what the starting process holds as its memory.

    A program that takes longer than timeout_s is ended, with what it started, and has exit code 124 and no cost.
    """
    launcher = subprocess.Popen(
        [sys.executable, "-c", _LAUNCHER, *command],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        errors="replace",
        start_new_session=True,
    )
    try:
        counted, said = launcher.communicate(timeout=timeout_s)
    except BaseException as stopped:
        os.killpg(launcher.pid, signal.SIGKILL)
        if not isinstance(stopped, subprocess.TimeoutExpired):
            raise
        _, said = launcher.communicate()
        return Cost(float("nan"), float("nan"), 124, f"{said}\nno end after {timeout_s:.0f} s")
    cpu_s, memory_kb = counted.split()[-2:]
    return Cost(float(cpu_s), float(memory_kb) / _KB_PER_MB, launcher.returncode, said)
