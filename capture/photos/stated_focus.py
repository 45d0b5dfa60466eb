"""StatedFocus: a focus distance that the user gives, with the interval it stands for."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

from capture.photos.focus_metadata import FocusReading
from mrbokeh.system.errors import InputError


@dataclass(frozen=True)
class StatedFocus:
    """0 < nearest_m <= distance_m <= farthest_m, inf allowed; all equal where it is exact."""

    distance_m: float
    nearest_m: float
    farthest_m: float

    @classmethod
    def checked(cls, values: Sequence[object], where: str) -> "StatedFocus":
        """From a distance, or a distance with its nearest and farthest (None: exact); InputError where they cannot be."""
        given = [*values, None, None][:3]
        numbers = [given[0], *(given[0] if each is None else each for each in given[1:])]
        if any(isinstance(each, bool) or not isinstance(each, (int, float)) or math.isnan(each) for each in numbers):
            raise InputError(f"{where} must be a number of metres, or a distance with its nearest and farthest, got {_listed(values)}")
        distance_m, nearest_m, farthest_m = (float(each) for each in numbers if isinstance(each, (int, float)))
        if min(distance_m, nearest_m, farthest_m) <= 0:
            raise InputError(f"{where} must be positive (inf is allowed), got {_listed(values)}")
        if not nearest_m <= distance_m <= farthest_m:
            raise InputError(f"{where}: the distance must lie between its nearest and farthest, got {_listed(values)}")
        return cls(distance_m, nearest_m, farthest_m)

    def reading(self, origin: str, source: str) -> FocusReading:
        return FocusReading(self.distance_m, self.nearest_m, self.farthest_m, origin, f"{source} = {self.distance_m:g} m")


def _listed(values: Sequence[object]) -> str:
    return ", ".join(str(each) for each in values if each is not None) or "nothing"
