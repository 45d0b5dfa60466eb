"""Rhythm: the times of a recording as they pass in reality."""

import time
from collections.abc import Callable
from threading import Event


class Rhythm:
    """Waits for the times of a recording; what is late is not hurried after."""

    def __init__(self, stopping: Event, now_s: Callable[[], float] = time.monotonic) -> None:
        self._stopping, self._now_s = stopping, now_s
        self._start_s: float | None = None
        self._due_s = now_s()

    def restart(self, pause_s: float) -> None:
        """The recording begins again, `pause_s` after the last time waited for."""
        self._start_s = None
        self._due_s += pause_s

    def wait_for(self, time_s: float) -> bool:
        """False if the stop came first."""
        if self._start_s is None:
            self._start_s = self._due_s - time_s
        self._due_s = self._start_s + time_s
        ahead_s = self._due_s - self._now_s()
        if ahead_s < 0:
            self._start_s -= ahead_s
            self._due_s -= ahead_s
        return not self._stopping.wait(max(ahead_s, 0.0))
