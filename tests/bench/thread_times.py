"""How much processor time each thread of this process spends, as Linux counts it."""

import os
import threading
import time
from collections import Counter
from pathlib import Path

_TICKS_PER_S = os.sysconf("SC_CLK_TCK")


class ThreadTimes:
    """From its making to `stop`. Threads that Python did not start (of codecs and of libraries) go by "native"."""

    def __init__(self) -> None:
        self._started_s, self._began = time.monotonic(), _ticks()
        self.shares: dict[str, float] = {}

    def stop(self) -> None:
        took_s, ticks = time.monotonic() - self._started_s, _ticks()
        names = {thread.native_id: thread.name for thread in threading.enumerate()}
        spent = Counter[str]()
        for thread_id, now in ticks.items():
            spent[names.get(thread_id, "native")] += now - self._began.get(thread_id, 0)
        self.shares = {name: count / _TICKS_PER_S / took_s for name, count in spent.most_common()}

    def line(self) -> str:
        return ", ".join(f"{name} {100 * share:.0f} %" for name, share in self.shares.items() if share >= 0.01)


def _ticks() -> dict[int, int]:
    """User and system time by thread; none where there is no /proc."""
    found = {}
    for path in Path("/proc/self/task").glob("*/stat"):
        try:
            after_name = path.read_text().rpartition(")")[2].split()
        except OSError:
            continue
        found[int(path.parent.name)] = int(after_name[11]) + int(after_name[12])
    return found
