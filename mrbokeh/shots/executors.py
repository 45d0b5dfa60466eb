"""Executors: who renders the segments of a shot: this process, worker processes of this machine, or a Dask cluster.

A SegmentTask is one segment, rendered from the clip to its part; the same in this process, in another and on another machine.
"""

import pickle
import secrets
import signal
import threading
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, ThreadPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import repeat
from multiprocessing import get_context, parent_process
from os import _exit
from pathlib import Path
from typing import Any, Protocol, runtime_checkable

from mrbokeh import __version__
from mrbokeh.shots.shot import FrameMaker, MakerRecipe, Picture, Segment, Shot
from mrbokeh.system.errors import InputError, MissingExtraError
from mrbokeh.system.resources import CallingThread, ahead, cores
from mrbokeh.video.clip import Frame
from mrbokeh.video.picture_source import frames_taken

Make = Callable[[int, Frame], Picture]
Write = Callable[[int, Frame, Picture], None]

AT_ONCE = 2
"""How many decoded frames wait to be made, and how many made ones to be written: more would take memory, not time."""

_built = threading.local()


@dataclass(frozen=True, eq=False)
class SegmentTask:
    """Segment to render. folder: of the parts. threads: number of cores it may use; with one, nothing runs beside anything else."""

    shot: Shot
    segment: Segment
    folder: Path
    threads: int = 1


def render_segment(task: SegmentTask, made: Callable[[], None] = lambda: None) -> int:
    """Render one part, unless it is there; return the number of the segment. made: called after every frame."""
    shot, segment = task.shot, task.segment
    if shot.target.part(task.folder, segment).exists():
        return segment.number
    maker, begin_s = _maker(shot.recipe, task.threads), shot.begin_s
    with shot.target.writing(shot, segment, task.folder) as sink:

        def write(index: int, frame: Frame, picture: Picture) -> None:
            sink.write(picture, index, frame.time_s - begin_s)
            made()

        def make(index: int, frame: Frame) -> Picture:
            return maker.make(index, frame.rgb, frame.time_s, frame.alpha)

        frames = zip(segment.taken, frames_taken(shot.source, segment.taken, task.threads), strict=True)
        stream(frames, make, write, overlap=task.threads != 1)
    return segment.number


def stream(numbered: Iterator[tuple[int, Frame]], make: Make, write: Write, *, overlap: bool = True) -> None:
    """Decode, render and write numbered frames in their order.

    Decoding and writing run beside the rendering, a few frames at a time. overlap: False does all in the calling thread, for a worker
    that has one core.
    """
    with _one_thread(overlap) as decoding, _one_thread(overlap) as encoding:
        under_way: deque[Future[None]] = deque()
        for each in ahead(decoding, lambda _: next(numbered, None), repeat(None), AT_ONCE if overlap else 1):
            if each is None:
                break
            under_way.append(encoding.submit(write, *each, make(*each)))
            if len(under_way) > AT_ONCE or not overlap:
                under_way.popleft().result()
        while under_way:
            under_way.popleft().result()


def _one_thread(overlap: bool) -> ThreadPoolExecutor | CallingThread:
    return ThreadPoolExecutor(1) if overlap else CallingThread()


def _maker(recipe: MakerRecipe, threads: int) -> FrameMaker:
    """Return the maker built last in this thread, as long as the recipe stays the same: it may hold tables and scenes."""
    key = pickle.dumps((recipe, threads))
    if getattr(_built, "key", None) != key:
        _built.key, _built.maker = None, None
        _built.maker, _built.key = recipe.build(threads), key
    maker: FrameMaker = _built.maker
    return maker


Progress = Callable[[int], None]
"""Told how many frames more are made; the number shrinks where a worker died and its segment begins anew."""

_TRIES = 3
_POLL_S = 0.25


@runtime_checkable
class Executor(Protocol):
    @property
    def threads(self) -> int:
        """Number of cores that each task may use."""
        ...

    def run(self, tasks: Sequence[SegmentTask], progress: Progress) -> None:
        """Render every segment; a worker that dies loses only the segment that it was at. Finished segments stay."""
        ...


class SerialExecutor:
    """Executor that renders the segments one after the other in this process. threads: of the renderer, 0 for all cores."""

    def __init__(self, threads: int = 0) -> None:
        self.threads = threads

    def run(self, tasks: Sequence[SegmentTask], progress: Progress) -> None:
        for task in tasks:
            render_segment(task, lambda: progress(1))


class ProcessExecutor:
    """Executor with worker processes, one segment each at a time.

    Workers are started afresh (spawn), for threads do not survive a fork; they leave when this process does. count: of the workers.
    threads: of each, so that all of them together take the machine and no more.
    """

    def __init__(self, count: int, threads: int = 0) -> None:
        self.count = count
        self.threads = threads or max(1, cores() // count)

    def run(self, tasks: Sequence[SegmentTask], progress: Progress) -> None:
        """Render every segment. Raises InputError if workers keep dying without finishing anything."""
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
        """Return the numbers of the segments finished until all are, or a worker died."""
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
            shown.settle(sum(len(task.segment.taken) for task in futures.values() if task.segment.number in numbers))
        return numbers


class _Board:
    """State that workers share with their parent: how many frames were made, and whether to stop."""

    def __init__(self, made: Any, stop: Any) -> None:
        self.made, self.stop = made, stop

    def count_one(self) -> None:
        with self.made.get_lock():
            self.made.value += 1
        if self.stop.is_set():
            raise _StopWorkingError


class _Shown:
    """Progress that the user has been told."""

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
    """Set up a new worker: Ctrl-C is the parent's to handle, and a worker without parent ends."""
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
    return render_segment(task, _board.count_one if _board is not None else lambda: None)


class DaskExecutor:
    """Executor on a Dask cluster whose workers see the same files under the same names.

    address: of the scheduler, tcp://HOST:8786. Each task takes one core, so start workers with one thread each. Dask gives the segment
    of a dead worker to another; one that kills four workers is given up.
    """

    threads = 1

    def __init__(self, address: str, patience_s: float = 10.0) -> None:
        self.address, self._patience_s = address, patience_s

    def run(self, tasks: Sequence[SegmentTask], progress: Progress) -> None:
        if not tasks:
            return
        with self._client() as client:
            require_same_files(client, tasks[0].folder, tasks[0].shot.source.path)
            self._compute(client, tasks, progress)

    def _compute(self, client: Any, tasks: Sequence[SegmentTask], progress: Progress) -> None:
        from distributed import KilledWorker, as_completed

        futures = {client.submit(render_segment, task, pure=False): task for task in tasks}
        try:
            for future in as_completed(list(futures), loop=client.loop):
                future.result()
                progress(len(futures[future].segment.taken))
        except KilledWorker as error:
            raise InputError(f"one segment killed the workers of {self.address} again and again (too little memory?): {error}") from None
        finally:
            client.cancel(list(futures))

    @contextmanager
    def _client(self) -> Iterator[Any]:
        try:
            from distributed import Client
        except ModuleNotFoundError:
            raise MissingExtraError("distributed", "cluster") from None
        try:
            client = Client(self.address, timeout=self._patience_s, set_as_default=False)
        except (OSError, ValueError) as error:
            raise InputError(f"no Dask scheduler answers at {self.address} ({error}): start one with `dask scheduler`") from None
        with client:
            yield client


def require_same_files(client: Any, folder: Path, clip: Path) -> None:
    """Raise InputError unless every worker reads what is written here, sees the clip and runs this version."""
    token, secret = folder / f"token-{secrets.token_hex(4)}", secrets.token_hex(16)
    token.write_text(secret, encoding="utf-8")
    try:
        reports = client.run(_report, str(token), str(clip))
    finally:
        token.unlink(missing_ok=True)
    if not reports:
        raise InputError("the cluster has no workers: start some with `dask worker ADDRESS --nthreads 1`")
    for worker, (read, sees_clip, version) in reports.items():
        if version != __version__:
            raise InputError(f"worker {worker} runs mrbokeh {version}, but this is {__version__}: install the same version on both")
        if read != secret or not sees_clip:
            lacking = folder if read != secret else clip
            raise InputError(
                f"worker {worker} does not see {lacking}: a cluster needs a file system that all machines share under one name"
            )


def _report(token: str, clip: str) -> tuple[str, bool, str]:
    """Return, on a worker, (content of the token, whether the clip is there, version)."""
    from mrbokeh.video.image_sequence import NumberedFiles, is_pattern

    try:
        read = Path(token).read_text(encoding="utf-8")
    except OSError:
        read = ""
    try:
        there = bool(NumberedFiles.found(Path(clip)).files) if is_pattern(clip) else Path(clip).is_file()
    except InputError:
        there = False
    return read, there, __version__
