"""How much processor time threads, processes and the whole machine spend, as Linux counts it."""

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
            found[int(path.parent.name)] = _spent(path)
        except OSError:
            continue
    return found


def _spent(stat: Path) -> int:
    after_name = stat.read_text().rpartition(")")[2].split()
    return int(after_name[11]) + int(after_name[12])


def process_s(process: int) -> float:
    """Return the user and system time of a process with all its threads, 0 where there is no /proc."""
    stat = Path(f"/proc/{process}/stat")
    return _spent(stat) / _TICKS_PER_S if stat.is_file() else 0.0


def machine_s() -> float:
    """Return the time in which the cores were not idle, all together, with what a host took away; 0 where there is no /proc."""
    stat = Path("/proc/stat")
    if not stat.is_file():
        return 0.0
    user, nice, system, _, _, interrupts, soft, stolen = map(int, stat.read_text().split()[1:9])
    return (user + nice + system + interrupts + soft + stolen) / _TICKS_PER_S
