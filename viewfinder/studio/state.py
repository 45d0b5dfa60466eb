"""StudioState: everything that decides what the studio's picture looks like, as plain values, checked when they come from outside."""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any

from mrbokeh.system.errors import InputError

Pair = tuple[float, float]
DrawnLine = tuple[float, float, float, float, str]
"""Both ends of an edge in pixels, and its direction in the world: "y" upright, "x" and "z" the two level ones; "h" is the horizon."""

Measured = tuple[float, float, float, float, float]
"""Both ends in pixels of something that stands upright on the ground, and how many metres high it is."""

_DIGITS = 6
"""Significant digits of numbers: the command line shows them all, so that it makes the very same picture."""


@dataclass(frozen=True)
class Placed:
    """An object that stands in the photograph: its file, place, height and turn, as of StudioState."""

    object: Path
    at_px: Pair
    height: str | None = None
    turn_deg: float = 0.0

    def document(self) -> dict[str, Any]:
        """Return what JSON keeps."""
        return {"object": str(self.object), "at_px": list(self.at_px), "height": self.height, "turn_deg": self.turn_deg}


@dataclass(frozen=True)
class StudioState:
    """State of the studio; None leaves a thing to the command's own default.

    photo: a photograph, or the folder of a focal stack, of which slice counts the pictures from 0; of a clip its first frame, and track
    is the file of its cameras. matte: what of the photograph the brush
    says is in front. object, at_px, height, turn_deg: of the chosen object; before, after: those that come before and after it in the
    command line. at_px: where it stands, in pixels of the whole photograph. height: metres such as "0.3", or pixels such as "120px".
    focus_at_px: the pixel that is in focus, where the photograph has depth; focus_m otherwise. sun_deg: where the main light comes from,
    degrees to the right of the view and above the horizon. camera: file of `mrbokeh capture solve`; pitch_deg and
    roll_deg (clockwise) come before it. lines: drawn ones, by which it was solved. measured: by which camera_height_m
    was found. warmth_k: of --match-white, by
    which objects are as warm as under a light of daylight's colour in a photograph balanced for so many kelvin. matched: black and grain
    of the objects are those of the photograph. plain: guess neither light nor ground.
    """

    photo: Path | None = None
    clip: Path | None = None
    track: Path | None = None
    slice: int | None = None
    depth: Path | None = None
    matte: Path | None = None
    object: Path | None = None
    lens: Path | None = None
    camera: Path | None = None
    lines: tuple[DrawnLine, ...] = ()
    at_px: Pair | None = None
    height: str | None = None
    turn_deg: float = 0.0
    before: tuple[Placed, ...] = ()
    after: tuple[Placed, ...] = ()
    pitch_deg: float | None = None
    roll_deg: float | None = None
    camera_height_m: float | None = None
    measured: Measured | None = None
    focal_length_mm: float | None = None
    sensor_width_mm: float | None = None
    f_number: float | None = None
    focus_m: float | None = None
    focus_at_px: Pair | None = None
    sun_deg: Pair | None = None
    shadow: float | None = None
    exposure: float = 1.0
    warmth_k: float | None = None
    matched: bool = True
    plain: bool = False

    @property
    def is_complete(self) -> bool:
        """Whether there is a photograph, an object, and a place for it."""
        return self.photo is not None and self.object is not None and self.at_px is not None

    @property
    def objects(self) -> tuple[Placed, ...]:
        """All objects that have a place, in the order of the command line."""
        chosen = () if self.object is None or self.at_px is None else (Placed(self.object, self.at_px, self.height, self.turn_deg),)
        return (*self.before, *chosen, *self.after)

    def scaled(self, factor: float) -> "StudioState":
        """Return the state with all heights in metres times a factor, by which objects look as large on ground so much farther away."""

        def times(height: str | None) -> str | None:
            return height if height is None or height.endswith("px") else f"{factor * float(height):.{_DIGITS}g}"

        before, after = (tuple(replace(each, height=times(each.height)) for each in placed) for placed in (self.before, self.after))
        return replace(self, height=times(self.height), before=before, after=after)

    def with_object(self, path: Path, beside_px: float) -> "StudioState":
        """Return the state with one more object, which is chosen: so far to the right of the chosen one, and as high.

        Where the chosen one has no place it takes its part. Raises InputError for more objects than a state holds.
        """
        if len(self.objects) >= _MOST_OBJECTS:
            raise InputError(f"there are {_MOST_OBJECTS} objects already: remove one first")
        if self.object is None or self.at_px is None:
            return replace(self, object=path, height=None)
        before = self.objects[: len(self.before) + 1]
        x_px, y_px = self.at_px
        return replace(self, object=path, at_px=(_rounded(x_px + beside_px), y_px), turn_deg=0.0, before=before)

    def document(self) -> dict[str, Any]:
        """Return what JSON keeps: every value by its name."""
        values = {each.name: getattr(self, each.name) for each in fields(self)}
        return {
            name: _kept(list(value)) if isinstance(value, tuple) else str(value) if isinstance(value, Path) else value
            for name, value in values.items()
        }


def _kept(values: list[Any]) -> list[Any]:
    return [each.document() if isinstance(each, Placed) else each for each in values]


def state_of(document: Any) -> StudioState:
    """Return the state of a document of a page or a project file. Raises InputError that names the first value that cannot be meant."""
    if not isinstance(document, Mapping):
        raise InputError(f"expected the state of the studio as an object of names and values, got {type(document).__name__}")
    unknown = sorted(set(map(str, document)) - set(_CHECKS))
    if unknown:
        raise InputError(f"the state of the studio has no {unknown[0]!r}: expected {', '.join(_CHECKS)}")
    given = {name: _CHECKS[name](name, value) for name, value in document.items() if value is not None}
    state = StudioState(**given)
    if state.focus_m is not None and state.focus_at_px is not None:
        raise InputError("focus_m and focus_at_px both say where the focus lies: leave one of them out")
    if state.sun_deg is not None and state.plain:
        raise InputError("sun_deg adds a main light, and plain takes all guessed light away: leave one of them out")
    return state


@dataclass(frozen=True)
class Stroke:
    """Line of a brush. points_px: x, y in pixels of the photograph. radius_px: of the brush. is_front: what it marks is in front."""

    points_px: tuple[Pair, ...]
    radius_px: float
    is_front: bool


def stroke_of(document: Mapping[str, Any]) -> Stroke:
    """Return the stroke of a page's message. Raises InputError that names the first value that cannot be meant."""
    points = document.get("points")
    if not isinstance(points, list) or not 0 < len(points) <= _MOST_POINTS:
        raise InputError(f"expected the points of a stroke as a list of 1 to {_MOST_POINTS}, got {_shown(points)}")
    within = _pair(_PIXELS, _PIXELS)
    line = tuple(within(f"points[{number}]", each) for number, each in enumerate(points))
    return Stroke(line, _number(1.0, _PIXELS[1])("radius", document.get("radius")), _flag("front", document.get("front")))


def shadow_of(document: Mapping[str, Any]) -> tuple[Pair, ...]:
    """Return three pixels of a page's message: top and foot of something upright, and its shadow's tip. Raises InputError."""
    points = document.get("points")
    if not isinstance(points, list) or len(points) != 3:
        raise InputError(f"expected three points, of a top, a foot and a shadow's tip, got {_shown(points)}")
    within = _pair(_PIXELS, _PIXELS)
    return tuple(within(f"points[{number}]", each) for number, each in enumerate(points))


def _path(name: str, value: Any) -> Path:
    if not isinstance(value, str) or not value or "\0" in value or len(value) > 4096:
        raise InputError(f"expected {name} to be the name of a file, got {_shown(value)}")
    return Path(value)


def _number(low: float, high: float) -> Callable[[str, Any], float]:
    """Return a check for numbers from low up to high."""

    def checked(name: str, value: Any) -> float:
        if isinstance(value, bool) or not isinstance(value, int | float) or not (math.isfinite(value) and low <= value <= high):
            raise InputError(f"expected {name} to be a number from {low:g} to {high:g}, got {_shown(value)}")
        return _rounded(float(value))

    return checked


def _whole(least: int, most: int) -> Callable[[str, Any], int]:
    """Return a check for whole numbers from least up to most."""

    def checked(name: str, value: Any) -> int:
        if isinstance(value, bool) or not isinstance(value, int) or not least <= value <= most:
            raise InputError(f"expected {name} to be a whole number from {least} to {most}, got {_shown(value)}")
        return value

    return checked


def _pair(first: tuple[float, float], second: tuple[float, float]) -> Callable[[str, Any], Pair]:
    """Return a check for two numbers in two ranges."""

    def checked(name: str, value: Any) -> Pair:
        if not isinstance(value, list | tuple) or len(value) != 2:
            raise InputError(f"expected {name} to be two numbers, got {_shown(value)}")
        return _number(*first)(f"{name}[0]", value[0]), _number(*second)(f"{name}[1]", value[1])

    return checked


def _placed(name: str, value: Any) -> tuple[Placed, ...]:
    """Return objects that have a place, of their documents."""
    if not isinstance(value, list | tuple) or len(value) > _MOST_OBJECTS:
        raise InputError(f"expected {name} to be a list of at most {_MOST_OBJECTS} objects, got {_shown(value)}")
    known = [each.name for each in fields(Placed)]
    placed = []
    for each in value:
        if not isinstance(each, Mapping) or None in (each.get("object"), each.get("at_px")) or not set(each) <= set(known):
            raise InputError(f"expected each of {name} to have object, at_px, height and turn_deg, got {_shown(each)}")
        placed.append(Placed(**{key: _CHECKS[key](f"{name}.{key}", one) for key, one in each.items() if one is not None}))
    return tuple(placed)


def _lines(name: str, value: Any) -> tuple[DrawnLine, ...]:
    """Return lines that are drawn on the photograph."""
    if not isinstance(value, list | tuple) or len(value) > _MOST_LINES:
        raise InputError(f"expected {name} to be a list of at most {_MOST_LINES} lines, got {_shown(value)}")
    pixel, lines = _number(*_PIXELS), []
    for each in value:
        if not isinstance(each, list | tuple) or len(each) != 5 or each[4] not in ("x", "y", "z", "h"):
            raise InputError(f"expected each of {name} as x1, y1, x2, y2 and its direction x, y, z or h, got {_shown(each)}")
        x1, y1, x2, y2 = (pixel(name, one) for one in each[:4])
        if math.hypot(x2 - x1, y2 - y1) < 1.0:
            raise InputError(f"expected each of {name} between two pixels, got {_shown(each)}: draw along an edge")
        lines.append((x1, y1, x2, y2, each[4]))
    return tuple(lines)


def _measured(name: str, value: Any) -> Measured:
    """Return something upright of known height: both its ends, and metres."""
    if not isinstance(value, list | tuple) or len(value) != 5:
        raise InputError(f"expected {name} to be x1, y1, x2, y2 and metres, got {_shown(value)}")
    x1, y1, x2, y2 = (_number(*_PIXELS)(name, each) for each in value[:4])
    return x1, y1, x2, y2, _number(0.001, 10_000.0)(f"metres of {name}", value[4])


def _flag(name: str, value: Any) -> bool:
    if not isinstance(value, bool):
        raise InputError(f"expected {name} to be true or false, got {_shown(value)}")
    return value


def _height(name: str, value: Any) -> str:
    """Return a height as --height takes it."""
    text = value.strip() if isinstance(value, str) else ""
    unit = "px" if text.endswith("px") else ""
    try:
        number = float(text.removesuffix("px"))
    except ValueError:
        number = math.nan
    if not 0.0 < number <= 1e6:
        raise InputError(f"expected {name} in metres above 0 such as 0.3, or in pixels such as 120px, got {_shown(value)}")
    return f"{number:.{_DIGITS}g}{unit}"


def _rounded(value: float) -> float:
    return float(f"{value:.{_DIGITS}g}")


def _shown(value: Any) -> str:
    return repr(value)[:60]


_PIXELS, _MOST_OBJECTS, _MOST_POINTS, _MOST_LINES = (0.0, 200_000.0), 50, 2000, 60
_CHECKS: dict[str, Callable[[str, Any], Any]] = {
    "photo": _path,
    "clip": _path,
    "track": _path,
    "slice": _whole(0, 100_000),
    "depth": _path,
    "matte": _path,
    "object": _path,
    "lens": _path,
    "camera": _path,
    "lines": _lines,
    "at_px": _pair(_PIXELS, _PIXELS),
    "height": _height,
    "turn_deg": _number(-100_000.0, 100_000.0),
    "before": _placed,
    "after": _placed,
    "pitch_deg": _number(-89.0, 89.0),
    "roll_deg": _number(-89.0, 89.0),
    "camera_height_m": _number(0.001, 10_000.0),
    "measured": _measured,
    "focal_length_mm": _number(0.1, 10_000.0),
    "sensor_width_mm": _number(0.1, 500.0),
    "f_number": _number(0.1, 1000.0),
    "focus_m": _number(0.001, 1e6),
    "focus_at_px": _pair(_PIXELS, _PIXELS),
    "sun_deg": _pair((-360.0, 360.0), (0.1, 90.0)),
    "shadow": _number(0.0, 1.0),
    "exposure": _number(0.0, 1000.0),
    "warmth_k": _number(2000.0, 25_000.0),
    "matched": _flag,
    "plain": _flag,
}
"""Checks of what comes from a page or a file, by the names of the state's values."""
