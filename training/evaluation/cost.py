"""What a picture costs: time, and memory beyond what the process held before."""

import ctypes
import gc
import time
from collections.abc import Callable
from pathlib import Path
from typing import TypeVar

Result = TypeVar("Result")
_STATUS, _RESET = Path("/proc/self/status"), Path("/proc/self/clear_refs")
_FORGET_PEAK = "5"


def timed(work: Callable[[], Result]) -> tuple[Result, float]:
    """(the result, seconds)."""
    started_s = time.perf_counter()
    result = work()
    return result, time.perf_counter() - started_s


def peak_memory_mib(work: Callable[[], object]) -> float:
    """How far the memory of the process rises while `work` runs; nan where the system (other than Linux) does not tell.

    What is loaded before, such as the weights of a network, does not count; freed memory is given back to the system first.
    """
    _give_back()
    try:
        _RESET.write_text(_FORGET_PEAK, encoding="ascii")
        before_kib = _status_kib("VmRSS")
        work()
        return (_status_kib("VmHWM") - before_kib) / 1024.0
    except OSError:
        return float("nan")


def _give_back() -> None:
    gc.collect()
    try:
        ctypes.CDLL("libc.so.6").malloc_trim(0)
    except (OSError, AttributeError):
        return


def _status_kib(name: str) -> int:
    line = next(each for each in _STATUS.read_text(encoding="ascii").splitlines() if each.startswith(f"{name}:"))
    return int(line.split()[1])
