"""Executors: who renders the segments of a shot: this process, worker processes of this machine, or a Dask cluster.

The first two claim segments on the disk where the parts lie, so that the same command on several machines shares the work.

A SegmentTask is one segment, rendered from the clip to its part; the same in this process, in another and on another machine.
"""

import os
import pickle
import secrets
import signal
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from functools import partial
from itertools import repeat
from multiprocessing import connection, get_context, resource_tracker
from pathlib import Path
from typing import Any, Protocol, runtime_checkable

from mrbokeh import __version__
from mrbokeh.shots.claims import claimed
from mrbokeh.shots.shot import MANIFEST, FrameMaker, MakerRecipe, Picture, Segment, Shot
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
CLAIM = ".claim"
"""Suffix of the sign that somebody renders a segment (`mrbokeh.shots.claims`)."""


@runtime_checkable
class Executor(Protocol):
    @property
    def threads(self) -> int:
        """Number of cores that each task may use."""
        ...

    def run(self, tasks: Sequence[SegmentTask], progress: Progress) -> None:
        """Render every segment; a worker that dies loses only the segment that it was at. Finished segments stay."""
        ...


Tell = Callable[[str, int], None]
"""Told ("begun" | "made", number of the segment)."""


def work_off(tasks: Sequence[SegmentTask], tell: Tell) -> None:
    """Render segments that nobody else has claimed until all are there, whoever made them.

    Other processes, on any machine that sees the same disk, may do the same at the same time. Ends early if the folder of the parts is
    gone: then somebody has joined them.
    """
    remaining = list(tasks)
    while remaining:
        worked = False
        for task in list(remaining):
            number, part = task.segment.number, task.shot.target.part(task.folder, task.segment)
            if not part.exists():
                if not (task.folder / MANIFEST).exists():
                    return
                with claimed(task.folder / f"{number:05d}{CLAIM}") as is_ours:
                    if not is_ours:
                        continue
                    tell("begun", number)
                    render_segment(task, partial(tell, "made", number))
                    worked = True
            remaining.remove(task)
        if remaining and not worked:
            time.sleep(_POLL_S)


class _Tally:
    """Frames made, by whomever, of which the user is told."""

    def __init__(self, tasks: Sequence[SegmentTask], progress: Progress) -> None:
        self._missing = {task.segment.number: task for task in tasks}
        self._made = dict.fromkeys(self._missing, 0)
        self._progress, self._told = progress, 0

    def tell(self, what: str, number: int) -> None:
        if number in self._missing:  # words about a part that was found finished may come late
            self._made[number] = self._made[number] + 1 if what == "made" else 0
            self.update()

    @property
    def missing(self) -> int:
        """Number of segments that were not there at the last look."""
        return len(self._missing)

    def look(self) -> None:
        """See which parts are there; all are, if somebody has joined them."""
        task = next(iter(self._missing.values()), None)
        if task is None:
            return
        names = {entry.name for entry in os.scandir(task.folder)} if (task.folder / MANIFEST).exists() else None
        for number, each in list(self._missing.items()):
            if names is None or each.shot.target.part(each.folder, each.segment).name in names:
                self._made[number] = len(self._missing.pop(number).segment.taken)
        self.update()

    def update(self) -> None:
        frames = sum(self._made.values())
        if frames != self._told:
            self._progress(frames - self._told)
            self._told = frames


class SerialExecutor:
    """Executor that renders the segments one after the other in this process. threads: of the renderer, 0 for all cores."""

    def __init__(self, threads: int = 0) -> None:
        self.threads = threads

    def run(self, tasks: Sequence[SegmentTask], progress: Progress) -> None:
        tally = _Tally(tasks, progress)
        work_off(tasks, tally.tell)
        tally.look()


class ProcessExecutor:
    """Executor with worker processes, each of which claims one segment after the other.

    Workers are started afresh (spawn), for threads do not survive a fork; they leave when this process does. count: of the workers.
    threads: of each, so that all of them together take the machine and no more.
    """

    def __init__(self, count: int, threads: int = 0) -> None:
        self.count = count
        self.threads = threads or max(1, cores() // count)

    def run(self, tasks: Sequence[SegmentTask], progress: Progress) -> None:
        """Render every segment. Raises InputError if workers keep dying without finishing anything, and what they raise."""
        if not tasks:
            return
        tally, deaths, left = _Tally(tasks, progress), 0, len(tasks)
        workers = [_Worker(tasks) for _ in range(min(self.count, len(tasks)))]
        try:
            while workers:
                connection.wait([pipe for each in workers for pipe in (each.pipe, each.process.sentinel)], _POLL_S)
                for worker in list(workers):
                    if not worker.heard(tally.tell):
                        workers.remove(worker)
                        tally.look()
                        deaths, left = (0, tally.missing) if tally.missing < left else (deaths + 1, left)
                        if tally.missing and worker.process.exitcode and deaths < _TRIES:
                            workers.append(_Worker(tasks))
                tally.look()
        finally:
            for worker in workers:
                worker.stop()
            for worker in workers:
                worker.process.join()
        if tally.missing:
            raise InputError(
                f"worker processes died {deaths} times in a row without finishing a segment (too little memory?): "
                f"try fewer with --workers; what is finished stays"
            )


class _Worker:
    """Worker process and this end of its pipe: what it tells comes in, and the end of the pipe or a word tells it to stop.

    at_work: it has said that it is at work; before, while it imports, nothing is lost when it is ended.
    """

    def __init__(self, tasks: Sequence[SegmentTask]) -> None:
        context = get_context("spawn")
        self.pipe, theirs = context.Pipe()
        self.process, self.at_work = context.Process(target=_work, args=(theirs, tasks), daemon=True), False
        with _ctrl_c_later():
            self.process.start()
        theirs.close()

    def heard(self, tell: Tell) -> bool:
        """Pass on what the worker tells; return whether it is still at work. Raises what it raised."""
        try:
            while self.pipe.poll():
                heard = self.pipe.recv()
                if isinstance(heard, BaseException):
                    raise heard
                if heard == _AT_WORK:
                    self.at_work = True
                else:
                    tell(*heard)
        except (EOFError, ConnectionError):
            self.process.join()
        return self.process.is_alive()

    def stop(self) -> None:
        """Let the worker leave after its frame, without half files."""
        if not self.at_work and not self.pipe.poll():
            self.process.terminate()
        with suppress(OSError):
            self.pipe.send(None)


@contextmanager
def _ctrl_c_later() -> Iterator[None]:
    """Hold Ctrl-C back: processes started meanwhile never get it, so that they print no traces of their imports."""
    if not hasattr(signal, "pthread_sigmask"):  # Windows
        yield
        return
    resource_tracker.ensure_running()  # the first process would start it, which lets Ctrl-C through again
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


_AT_WORK = "at work"


class _StopWorkingError(Exception):
    """The parent wants no more."""


_stopping = threading.Event()
"""Set in a worker that is to leave."""


def _work(pipe: Any, tasks: Sequence[SegmentTask]) -> None:
    """Work in a process of its own: Ctrl-C is the parent's to handle, and a worker without parent ends at once."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    threading.Thread(target=_listen, args=(pipe,), daemon=True).start()
    if tasks[0].threads == 1:
        import cv2

        cv2.setNumThreads(1)

    def tell(what: str, number: int) -> None:
        pipe.send((what, number))
        if _stopping.is_set():
            raise _StopWorkingError

    try:
        pipe.send(_AT_WORK)
        work_off(tasks, tell)
    except _StopWorkingError:
        os._exit(0)  # nothing is left to do, and Ctrl-C waits for it
    except Exception as error:  # told by the parent
        pipe.send(error)


def _listen(pipe: Any) -> None:
    try:
        pipe.recv()
    except (EOFError, OSError):
        os._exit(1)
    _stopping.set()


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
