"""Rows of the device benchmark, and how they are timed: on the device, with transfers, and by the processor in the same run.

A part is a module of this folder with a function `rows(run)` that yields rows as they are ready. What it yields is written at once, so that
a part that fails, or is stopped because its time is up, keeps the rows it has.
"""

import os
import statistics
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple

import numpy as np
import torch

MEGABYTE = 1 << 20
WARM_UP = 2
MOST_REPEATS = 30


@dataclass(frozen=True)
class Row:
    """What was measured of one case. None is "not measured".

    device_ms: without transfers, the median after warming up. transfers_ms: with everything copied there and the result copied back.
    memory_mb: the most that torch held on the device meanwhile. cpu_ms: of the processor in the same run, by cpu_cores cores.
    largest_difference, psnr_db: of the device's result from the processor's; known is what it is compared with where that is another.
    published: what the authors state. bar_ms: no more is wanted. bar_ratio: at least so many times as fast as the processor is wanted.
    """

    name: str
    size: str = ""
    device_ms: float | None = None
    transfers_ms: float | None = None
    memory_mb: float | None = None
    cpu_ms: float | None = None
    cpu_cores: int | None = None
    largest_difference: float | None = None
    psnr_db: float | None = None
    published: str = ""
    bar_ms: float | None = None
    bar_ratio: float | None = None
    note: str = ""

    @property
    def ratio(self) -> float | None:
        """Return how many times as long the processor takes."""
        return self.cpu_ms / self.device_ms if self.cpu_ms and self.device_ms else None

    @property
    def bar(self) -> str:
        """Return the bar in words."""
        if self.bar_ms is not None:
            return f"{self.bar_ms:g} ms"
        return "" if self.bar_ratio is None else f"{self.bar_ratio:g} times"

    @property
    def met(self) -> bool | None:
        """Return whether the bar is met; None where there is none or nothing was measured."""
        if self.bar_ms is not None and self.device_ms is not None:
            return self.device_ms <= self.bar_ms
        if self.bar_ratio is not None and self.ratio is not None:
            return self.ratio >= self.bar_ratio
        return None

    def compared(self, found: Any, known: Any) -> "Row":
        """Return the row with how far two results are apart; the peak is the largest value of the known one."""
        found, known = (np.asarray(each.detach().float().cpu() if torch.is_tensor(each) else each, np.float64) for each in (found, known))
        return replace(self, largest_difference=float(np.abs(found - known).max()), psnr_db=likeness_db(found, known))

    def by_processor(self, work: Callable[[], object], run: "Run", most_s: float = 10.0) -> "Row":
        """Return the row with the time that the processor takes for the same."""
        cpu_ms = processor_ms(work, min(most_s, run.left_s / 4))
        return replace(self, cpu_ms=cpu_ms, cpu_cores=run.cores)


def size_of(picture: np.ndarray) -> str:
    """Return width x height in words."""
    return f"{picture.shape[1]} x {picture.shape[0]}"


def in_short(error: Exception) -> str:
    """Return what went wrong as the note of a row."""
    return f"failed: {type(error).__name__} {' '.join(str(error).split())[:300]}"


def likeness_db(found: np.ndarray, known: np.ndarray) -> float:
    """Return the PSNR with the largest known value as the peak; nothing is clipped."""
    mean = float(np.mean((found - known) ** 2))
    peak = float(np.abs(known).max()) or 1.0
    return float("inf") if mean == 0.0 else float(10.0 * np.log10(peak**2 / mean))


class Timing(NamedTuple):
    """ms: median of `repeats` after warming up. memory_mb: the most held on the device; None on the processor."""

    ms: float
    memory_mb: float | None
    repeats: int


@dataclass
class Run:
    """Where a part runs and how long it may.

    device: of torch. small: there is no GPU, so that the processor stands in and everything is smaller. ends_s: when the part's time is up,
    by `time.monotonic`. tell: prints a line at once.
    """

    device: torch.device
    small: bool
    ends_s: float
    tell: Callable[[str], None]
    cores: int = field(default_factory=lambda: len(os.sched_getaffinity(0)))

    @property
    def left_s(self) -> float:
        return max(0.0, self.ends_s - time.monotonic())

    @property
    def name(self) -> str:
        """Return the name of the device for torch."""
        return str(self.device)

    def wait(self) -> None:
        """Wait until the device has done what it was asked to."""
        if self.device.type == "cuda":
            torch.cuda.synchronize(self.device)

    def on_device(self, array: np.ndarray) -> torch.Tensor:
        """Return a copy of the array on the device."""
        return torch.from_numpy(np.ascontiguousarray(array)).to(self.device)

    def timed(self, work: Callable[[], object], most_s: float = 4.0, repeats: int = MOST_REPEATS) -> Timing:
        """Time what lies on the device, with nothing copied: by CUDA events, one pair for each repetition."""
        for _ in range(WARM_UP if not self.small else 1):
            work()
        self.wait()
        if self.device.type == "cuda":
            torch.cuda.reset_peak_memory_stats(self.device)
        ms, until_s = [self._once(work)], time.monotonic() + min(most_s, self.left_s / 3)
        while len(ms) < repeats and time.monotonic() < until_s:
            ms.append(self._once(work))
        return Timing(statistics.median(ms), self.memory_mb(), len(ms))

    def memory_mb(self) -> float | None:
        """Return the most memory that torch held on the device since it was last asked to count; None on the processor."""
        return torch.cuda.max_memory_allocated(self.device) / MEGABYTE if self.device.type == "cuda" else None

    def measured(
        self, row: Row, work: Callable[[], object], with_transfers: Callable[[], object] | None = None, most_s: float = 3.0
    ) -> Row:
        """Return the row with the device's time, memory and, where that work is given, the time with transfers."""
        timing = self.timed(work, most_s)
        row = replace(row, device_ms=timing.ms, memory_mb=timing.memory_mb)
        return row if with_transfers is None else replace(row, transfers_ms=self.host_ms(with_transfers, most_s))

    def host_ms(self, work: Callable[[], object], most_s: float = 3.0) -> float:
        """Return the median by the host's clock, the device waited for."""

        def waited() -> None:
            work()
            self.wait()

        return processor_ms(waited, min(most_s, self.left_s / 3))

    def _once(self, work: Callable[[], object]) -> float:
        if self.device.type != "cuda":
            return once_ms(work)
        begin, end = (torch.cuda.Event(enable_timing=True) for _ in range(2))
        begin.record()
        work()
        end.record()
        end.synchronize()
        return float(begin.elapsed_time(end))


def processor_ms(work: Callable[[], object], most_s: float = 10.0, repeats: int = 10) -> float:
    """Return the median by the clock; the first time, in which numba may compile, is left out."""
    work()
    ms, until_s = [once_ms(work)], time.monotonic() + most_s
    while len(ms) < repeats and time.monotonic() < until_s:
        ms.append(once_ms(work))
    return statistics.median(ms)


def once_ms(work: Callable[[], object]) -> float:
    """Return how long this took once, by the clock."""
    begun_s = time.perf_counter()
    work()
    return 1e3 * (time.perf_counter() - begun_s)


@contextmanager
def threads_of_torch(count: int) -> Iterator[None]:
    """Let torch use so many cores of the processor meanwhile."""
    before = torch.get_num_threads()
    torch.set_num_threads(count)
    try:
        yield
    finally:
        torch.set_num_threads(before)
