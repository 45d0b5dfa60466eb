"""Focus as a user states it: in metres, by what is in focus at a pixel, or by where between the slices of a stack it lies."""

import re
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import count

import numpy as np
from jaxtyping import Float32

from mrbokeh.optics.lens import Lens
from mrbokeh.stacks.focal_stack import FocalStack
from mrbokeh.system.errors import InputError

_PLACE = r"@[^,:@#]+,[^,:@#]+|#[^,:@#]+|[^,:@#]+"
_EXPECTED = (
    "expected different places such as 0.8,1.2,inf (metres), @300,200 (what is seen at that pixel), #2.5 (between slices 2 and 3, "
    "counted from 0), or FROM:TO:COUNT of these, evenly in dioptres and so in blur"
)


@dataclass(frozen=True)
class FocusLookup:
    """Lookup of focus places.

    depth_m: of the picture, or None. slices_m: focus distances of the slices, in their order. within_px: how far around a pixel counts.
    """

    lens: Lens
    depth_m: Float32[np.ndarray, "height width"] | None = None
    slices_m: tuple[float, ...] = ()
    within_px: float = 2.0

    @classmethod
    def of(cls, stack: FocalStack) -> "FocusLookup":
        slices_m = tuple(each for each in stack.focus_distances_m if each is not None)
        return cls(stack.lens_of(stack.reference), stack.depth_m(), slices_m)

    def at_pixel(self, x_px: float, y_px: float) -> float:
        """Return the focus distance at which what is seen at a pixel is sharp."""
        if self.depth_m is None:
            raise InputError(f"--focus @{x_px:g},{y_px:g} needs the depth of the picture: give metres, or a stack")
        return self.lens.focused_on(self.depth_m, x_px + 0.5, y_px + 0.5, self.within_px).focus_distance_m

    def at_slice(self, position: float) -> float:
        """Return the focus distance at a place between slices, evenly in dioptres."""
        if not 0.0 <= position <= len(self.slices_m) - 1:
            last = f"#0 to #{len(self.slices_m) - 1}" if self.slices_m else "a focal stack, for a picture has no slices"
            raise InputError(f"--focus #{position:g}: expected {last}")
        # A whole number gives the distance of that slice to the last bit.
        if position == int(position):
            return self.slices_m[int(position)]
        return _distance(float(np.interp(position, np.arange(len(self.slices_m)), [1.0 / each for each in self.slices_m])))


MOST_PLACES, _BEYOND = 1000, 100.0


def parse_focus(text: str, seen: FocusLookup) -> tuple[float, ...]:
    """Return focus distances in metres, all different."""
    if not (places := _places(text, seen)) or not all(each > 0 for each in places) or len(set(places)) < len(places):
        raise InputError(f"--focus: {_EXPECTED}, got {text!r}")
    farthest_m = max((each for each in seen.slices_m if each < float("inf")), default=float("inf"))
    if beyond := [each for each in places if _BEYOND * farthest_m < each < float("inf")]:
        raise InputError(
            f"--focus: {beyond[0]:g} m is {beyond[0] / farthest_m:.0f} times as far as the farthest slice: a pixel is written @X,Y "
            f"(or --focus-at X,Y), and far away is inf"
        )
    return places


def _places(text: str, seen: FocusLookup) -> tuple[float, ...]:
    """Return nothing where the text is not as expected."""
    try:
        if parts := re.fullmatch(rf"({_PLACE}):({_PLACE}):(\d+)", text):
            near, far = (_place(each, seen) for each in parts.groups()[:2])
            if int(parts[3]) > MOST_PLACES:
                raise InputError(f"--focus: expected at most {MOST_PLACES} places, got {parts[3]}")
            return tuple(_distance(float(each)) for each in np.linspace(1.0 / near, 1.0 / far, int(parts[3])))
        if re.fullmatch(rf"(?:{_PLACE})(?:,(?:{_PLACE}))*", text):
            return tuple(_place(each, seen) for each in re.findall(_PLACE, text))
    except InputError:
        raise
    except (ValueError, ZeroDivisionError):
        pass
    return ()


def _place(text: str, seen: FocusLookup) -> float:
    if text[0] not in "@#":
        return float(text)
    numbers = tuple(float(each) for each in text[1:].split(","))
    return seen.at_pixel(numbers[0], numbers[1]) if text[0] == "@" else seen.at_slice(numbers[0])


def _distance(dioptres: float) -> float:
    return float("inf") if dioptres == 0.0 else 1.0 / dioptres


def slice_names(distances_m: tuple[float, ...]) -> list[str]:
    """Name the files of new slices, whose distances differ, with as many digits as tell them apart, four at least."""
    names = ([f"slice_{each:.{digits}f}m.exr" for each in distances_m] for digits in count(4))
    return next(each for each in names if len(set(each)) == len(each))


def index_between(distances_m: Sequence[float], dioptres: Float32[np.ndarray, "height width"]) -> Float32[np.ndarray, "height width"]:
    """Return the fractional index of the slice, among slices focused at these distances, in which a surface is sharp."""
    focus_dioptres = np.array([1.0 / each for each in distances_m])
    order = np.argsort(focus_dioptres)
    return np.interp(dioptres, focus_dioptres[order], order).astype(np.float32)
