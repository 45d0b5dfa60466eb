"""ProcessCrew: worker processes of this machine, one segment each at a time."""

import signal
import threading
from collections.abc import Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from multiprocessing import get_context, parent_process
from os import _exit
from typing import Any

from mrbokeh.shots.crew import Progress
from mrbokeh.shots.segment_task import SegmentTask, make_segment
from mrbokeh.system.errors import InputError
from mrbokeh.system.resources import cores

_TRIES = 3
_POLL_S = 0.25


class ProcessCrew:
    """A Crew. Workers are started afresh (spawn), for threads do not survive a fork; they leave when this process does.

    count: of the workers. threads: of each, so that all of them together take the machine and no more.
    """

    def __init__(self, count: int, threads: int = 0) -> None:
        self.count = count
        self.threads = threads or max(1, cores() // count)

    def run(self, tasks: Sequence[SegmentTask], progress: Progress) -> None:
        """Raises InputError where workers keep dying without finishing anything."""
        missing, deaths = list(tasks), 0
        while missing:
            done = self._try(missing, progress)
            deaths = 0 if done else deaths + 1
            missing = [task for task in missing if task.segment.number not in done]
            if missing and deaths >= _TRIES:
                raise InputError(
                    f"worker processes died {deaths} times in a row without finishing a segment (too little memory?): "
                    f"try fewer with --workers; what is finished stays"
                )

    def _try(self, tasks: Sequence[SegmentTask], progress: Progress) -> set[int]:
        """The numbers of the segments finished until all are, or a worker died."""
        context = get_context("spawn")
        board = _Board(context.Value("i", 0), context.Event())
        pool = ProcessPoolExecutor(min(self.count, len(tasks)), context, _begin, (board,))
        shown = _Shown(board, progress)
        try:
            futures = {pool.submit(_make_here, task): task for task in tasks}
            return self._finished(futures, shown)
        finally:
            board.stop.set()
            pool.shutdown(wait=True, cancel_futures=True)

    def _finished(self, futures: dict["Future[int]", SegmentTask], shown: "_Shown") -> set[int]:
        waiting, numbers = set(futures), set[int]()
        while waiting:
            done, waiting = wait(waiting, timeout=_POLL_S, return_when=FIRST_COMPLETED)
            shown.update()
            for future in done:
                try:
                    numbers.add(future.result())
                except BrokenProcessPool:
                    waiting = set()
        if len(numbers) < len(futures):
            shown.settle(sum(task.segment.frame_count for task in futures.values() if task.segment.number in numbers))
        return numbers


class _Board:
    """What the workers and their parent share: how many frames were made, and whether to stop."""

    def __init__(self, made: Any, stop: Any) -> None:
        self.made, self.stop = made, stop

    def count_one(self) -> None:
        with self.made.get_lock():
            self.made.value += 1
        if self.stop.is_set():
            raise _StopWorkingError


class _Shown:
    """How much of the board the user has been told."""

    def __init__(self, board: _Board, progress: Progress) -> None:
        self._board, self._progress, self._told = board, progress, 0

    def update(self) -> None:
        self.settle(self._board.made.value)

    def settle(self, frames: int) -> None:
        if frames != self._told:
            self._progress(frames - self._told)
            self._told = frames


class _StopWorkingError(Exception):
    """The parent wants no more."""


_board: _Board | None = None


def _begin(board: _Board) -> None:
    """In a new worker: Ctrl-C is the parent's to handle, and a worker without parent ends."""
    global _board
    _board = board
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    threading.Thread(target=_end_with_parent, daemon=True).start()


def _end_with_parent() -> None:
    parent = parent_process()
    if parent is not None:
        parent.join()
        _exit(1)


def _make_here(task: SegmentTask) -> int:
    return make_segment(task, _board.count_one if _board is not None else lambda: None)
