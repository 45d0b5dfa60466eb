"""Which end of a focus sweep is near: blur alone looks the same on both sides of the focus."""

from dataclasses import dataclass


@dataclass(frozen=True)
class Direction:
    """near_first: the first slice is focused nearest. source: what says so. sure: whether that is evidence and no guess."""

    near_first: bool
    source: str
    sure: bool


FILE_ORDER = Direction(near_first=True, source="file order", sure=False)
