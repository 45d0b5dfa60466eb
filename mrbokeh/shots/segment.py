"""Segment: a few seconds of a shot, made and kept as one."""

from typing import NamedTuple

SEGMENT_S = 2.0
"""Long enough that decoding from the keyframe before and a keyframe more cost little, short enough that a kill loses little."""


class Segment(NamedTuple):
    """Frames `start` to `stop` (excluded) of the clip; number: its place in the shot."""

    number: int
    start: int
    stop: int

    @property
    def frame_count(self) -> int:
        return self.stop - self.start


def segments_between(start: int, stop: int, frames: int) -> list[Segment]:
    return [Segment(number, first, min(first + frames, stop)) for number, first in enumerate(range(start, stop, frames))]
