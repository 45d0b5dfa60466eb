"""SegmentTask: one segment of a shot, made from the clip to its part; the same in this process, in another and on another machine."""

import pickle
import threading
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from mrbokeh.shots.frame_maker import FrameMaker, MakerRecipe, Picture
from mrbokeh.shots.segment import Segment
from mrbokeh.shots.shot import Shot
from mrbokeh.shots.streaming import stream
from mrbokeh.video.clip import Frame

_built = threading.local()


@dataclass(frozen=True, eq=False)
class SegmentTask:
    """folder: of the parts. threads: how many cores it may use; with one, nothing runs beside anything else."""

    shot: Shot
    segment: Segment
    folder: Path
    threads: int = 1


def make_segment(task: SegmentTask, made: Callable[[], None] = lambda: None) -> int:
    """Make one part, unless it is there; made: called after every frame. Returns the number of the segment."""
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


def _maker(recipe: MakerRecipe, threads: int) -> FrameMaker:
    """The one built last in this thread, as long as the recipe stays the same: it may hold tables and scenes."""
    key = pickle.dumps((recipe, threads))
    if getattr(_built, "key", None) != key:
        _built.key, _built.maker = None, None
        _built.maker, _built.key = recipe.build(threads), key
    maker: FrameMaker = _built.maker
    return maker
