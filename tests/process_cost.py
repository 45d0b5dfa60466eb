"""What a program costs as a whole: CPU seconds of all cores together, and memory."""

import subprocess
import sys

_LAUNCHER = """
import resource, subprocess, sys
done = subprocess.run(sys.argv[1:], stdout=subprocess.DEVNULL)
used = resource.getrusage(resource.RUSAGE_CHILDREN)
print(used.ru_utime + used.ru_stime, used.ru_maxrss)
sys.exit(done.returncode)
"""
_KB_PER_MB = 1024.0  # kilobytes, as Linux states the largest memory of a process


def mrbokeh(*arguments: object) -> tuple[float, float]:
    """A command of ours in a process of its own, see `measured`."""
    return measured([sys.executable, "-c", "from mrbokeh.cli import main; main()", *map(str, arguments)])


def measured(command: list[str]) -> tuple[float, float]:
    """(CPU seconds of all cores, largest memory in MB) of a program and those that it starts and waits for.

    A small process starts it, because Linux counts what the starting process holds as memory of the started one.
    """
    done = subprocess.run([sys.executable, "-c", _LAUNCHER, *command], capture_output=True, text=True)
    if done.returncode:
        raise SystemExit(f"{' '.join(command)} failed: {done.stderr[-500:]}")
    cpu_s, memory_kb = done.stdout.split()[-2:]
    return float(cpu_s), float(memory_kb) / _KB_PER_MB
