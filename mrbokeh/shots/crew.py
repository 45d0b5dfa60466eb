"""Crew: who makes the segments: this process, processes of this machine, or machines of a cluster."""

from collections.abc import Callable, Sequence
from typing import Protocol, runtime_checkable

from mrbokeh.shots.segment_task import SegmentTask, make_segment

Progress = Callable[[int], None]
"""Told how many frames more are made; the number shrinks where a worker died and its segment begins anew."""


@runtime_checkable
class Crew(Protocol):
    @property
    def threads(self) -> int:
        """How many cores each task may use."""
        ...

    def run(self, tasks: Sequence[SegmentTask], progress: Progress) -> None:
        """Make every segment; a worker that dies loses nothing but what it was at. What is finished stays, whatever happens."""
        ...


class OneProcess:
    """The segments one after the other, in this process. threads: of the renderer, 0 for all cores."""

    def __init__(self, threads: int = 0) -> None:
        self.threads = threads

    def run(self, tasks: Sequence[SegmentTask], progress: Progress) -> None:
        for task in tasks:
            make_segment(task, lambda: progress(1))
