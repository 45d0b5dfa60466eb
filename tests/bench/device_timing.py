"""How long work on a device of torch takes, for the benchmarks."""

import statistics
import time
from collections.abc import Callable

import torch

WAIT_S = 20.0


def milliseconds(run: Callable[[], object], device: torch.device) -> float:
    """The median of as many as there is time for, once the first is done."""
    took_ms: list[float] = []
    until_s = time.perf_counter() + WAIT_S
    while len(took_ms) < 30 and (not took_ms or time.perf_counter() < until_s):
        wait_for(device)
        started_s = time.perf_counter()
        run()
        wait_for(device)
        took_ms.append(1e3 * (time.perf_counter() - started_s))
    return statistics.median(took_ms)


def wait_for(device: torch.device) -> None:
    if device.type == "cuda":
        torch.cuda.synchronize(device)
