"""What a benchmark ran on: processor, commit and the memory it took."""

import os
import platform
import resource
import subprocess
from pathlib import Path


def machine_line() -> str:
    """Processor, cores, Python and commit in one line."""
    return f"{_processor()}, {os.cpu_count()} cores, Python {platform.python_version()}, commit {_commit()}"


def memory_line() -> str:
    """The largest memory that this process has held."""
    return f"largest memory of the process: {resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024:.0f} MB"


def _processor() -> str:
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
    except OSError:
        return platform.processor() or platform.machine()
    return next((line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")), platform.machine())


def _commit() -> str:
    root = Path(__file__).resolve().parents[2]
    done = subprocess.run(["git", "describe", "--always", "--dirty"], cwd=root, capture_output=True, text=True)
    return done.stdout.strip() or "unknown"
