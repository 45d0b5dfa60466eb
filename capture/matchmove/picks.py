"""Pixels of a clip as people write them: FRAME:X,Y/X,Y/..."""

import numpy as np

from capture.matchmove.ground import GroundPicks, Ruler
from mrbokeh.system.errors import InputError


def parse_ground(text: str) -> GroundPicks:
    """FRAME:X,Y/X,Y/X,Y, three pixels or more."""
    expected = "--ground must be FRAME:X,Y/X,Y/X,Y, three pixels or more with ground between them, such as 0:300,900/1500,900/900,700"
    try:
        frame, pixels = text.split(":")
        picks = GroundPicks(int(frame), np.array([_pixel(each) for each in pixels.split("/")], np.float64))
    except ValueError:
        raise InputError(f"{expected}, got {text!r}") from None
    if len(picks.xy_px) < 3 or picks.frame < 0:
        raise InputError(f"{expected}, got {text!r}")
    return picks


def parse_ruler(text: str) -> Ruler:
    """FRAME:X,Y/X,Y/METRES."""
    try:
        frame, rest = text.split(":")
        one, other, metres = rest.split("/")
        return Ruler(int(frame), np.array([_pixel(one), _pixel(other)], np.float64), float(metres))
    except ValueError:
        raise InputError(f"--ruler must be FRAME:X,Y/X,Y/METRES such as 0:300,900/1500,900/2.4, got {text!r}") from None


def parse_frame_distance(text: str) -> tuple[int, int, float]:
    """FRAME_A,FRAME_B,METRES."""
    try:
        one, other, metres = text.split(",")
        return int(one), int(other), float(metres)
    except ValueError:
        raise InputError(f"--distance must be FRAME,FRAME,METRES such as 0,120,1.5, got {text!r}") from None


def _pixel(text: str) -> tuple[float, float]:
    x, y = text.split(",")
    return float(x), float(y)
