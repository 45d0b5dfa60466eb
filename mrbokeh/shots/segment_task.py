"""SegmentTask: one segment of a shot, rendered from the clip to its part; the same in this process, in another and on another machine."""

import pickle
import threading
from collections import deque
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from itertools import repeat
from pathlib import Path

from mrbokeh.shots.shot import FrameMaker, MakerRecipe, Picture, Segment, Shot
from mrbokeh.system.resources import CallingThread, ahead
from mrbokeh.video.clip import Frame

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

        frames = shot.source.frames(segment.start, segment.stop, task.threads)
        stream(frames, segment.start, make, write, overlap=task.threads != 1)
    return segment.number


def stream(frames: Iterator[Frame], first: int, make: Make, write: Write, *, overlap: bool = True) -> None:
    """Decode, render and write frames in their order; the first has the number `first`.

    Decoding and writing run beside the rendering, a few frames at a time. overlap: False does all in the calling thread, for a worker
    that has one core.
    """
    numbered = enumerate(frames, first)
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
