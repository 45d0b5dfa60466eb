"""FocusReading: a focus distance as somebody stated it, and the way from there to the distance from the lens; numbers in exiv2's tags."""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar

from mrbokeh.optics.lens import MM_PER_M, lens_distance_m

Tags = Mapping[str, str]


@dataclass(frozen=True)
class FocusReading:
    """A focus distance with the interval it stands for; 0 < nearest_m <= distance_m <= farthest_m, inf allowed.

    origin: where the distance is counted from, "film_plane" or "lens".
    source: the tag and the number it held, as text.
    is_sentinel: whether that number stands for no distance at all (`SentinelReading`).
    """

    is_sentinel: ClassVar[bool] = False

    distance_m: float
    nearest_m: float
    farthest_m: float
    origin: str
    source: str

    def lens_distance_m(self, focal_length_mm: float | None, hiatus_mm: float = 0.0) -> float | None:
        """Distance from the front principal plane, or None where the focal length is needed and unknown or no lens of it fits."""
        return self._from_lens(self.distance_m, focal_length_mm, hiatus_mm)

    def lens_interval_m(self, focal_length_mm: float | None, hiatus_mm: float = 0.0) -> tuple[float, float] | None:
        """(nearest, farthest) from the front principal plane; None where the distance itself is not known from there."""
        distance_m = self.lens_distance_m(focal_length_mm, hiatus_mm)
        farthest_m = self._from_lens(self.farthest_m, focal_length_mm, hiatus_mm)
        if distance_m is None or farthest_m is None:
            return None
        nearest_m = self._from_lens(self.nearest_m, focal_length_mm, hiatus_mm)
        # Nearer than a lens of this focal length reaches: it ends at 1:1, two focal lengths before the lens.
        shortest_m = min(distance_m, 2.0 * (focal_length_mm or 0.0) / MM_PER_M)
        return (shortest_m if nearest_m is None else nearest_m), farthest_m

    def _from_lens(self, stated_m: float, focal_length_mm: float | None, hiatus_mm: float) -> float | None:
        if self.origin == "lens" or math.isinf(stated_m):
            return stated_m
        return None if focal_length_mm is None else lens_distance_m(stated_m, focal_length_mm, hiatus_mm)


@dataclass(frozen=True)
class SentinelReading(FocusReading):
    """Infinity by a number that stands for it (0xFFFFFFFF, 655.35 m): cameras write it for all that lies beyond their last code, be that
    3 m or 30 m, and where they do not know. A value to start from; the photographs of its stack bound it (`capture.stacks.sentinel_focus`).
    """

    is_sentinel: ClassVar[bool] = True


def at_infinity(source: str) -> SentinelReading:
    return SentinelReading(math.inf, math.inf, math.inf, "film_plane", source)


def rational(text: str | None) -> tuple[int, int] | None:
    """(numerator, denominator) of "17/10", of "17" or of the first number of several; None where there is no number."""
    if not text or not text.split():
        return None
    numerator, _, denominator = text.split()[0].partition("/")
    try:
        return int(numerator), int(denominator or 1)
    except ValueError:
        return None


def number(text: str | None) -> float | None:
    """The first number of a tag as float; None for nothing, 0/0 and x/0."""
    parts = rational(text)
    return None if parts is None or parts[1] == 0 else parts[0] / parts[1]
