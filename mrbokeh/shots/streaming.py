"""The frames of a segment on their way: decoded, made and written, a few at a time; decoding and writing run beside the making."""

from collections import deque
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from itertools import repeat

from mrbokeh.shots.frame_maker import Picture
from mrbokeh.system.resources import CallingThread, ahead
from mrbokeh.video.clip import Frame

Make = Callable[[int, Frame], Picture]
Write = Callable[[int, Frame, Picture], None]

AT_ONCE = 2
"""How many decoded frames wait to be made, and how many made ones to be written: more would take memory, not time."""


def stream(frames: Iterator[Frame], first: int, make: Make, write: Write, *, overlap: bool = True) -> None:
    """Everything happens in the order of the frames, of which the first has the number `first`.

    overlap: False does all in the calling thread, for a worker that has one core.
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
