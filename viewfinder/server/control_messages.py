"""Messages with which a page controls the viewfinder: typed, and checked before anything changes.

One JSON object with one verb: {"focus": {"distance_m": 2.5 or null}}, {"focus": {"at": [x, y]}}, {"f_number": 2.0}, {"lens": name},
{"renderer": name}, {"view": name}, {"object": {"name": name, "move_m": [x, z]}}, {"object": {"name": name, "visible": true}},
{"capture": {}}, {"record": true}, {"smoothing": true}.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from mrbokeh.system.errors import InputError

_LONGEST_NAME = 80
# A drag moves an object within a room; more is a slip of the finger over the horizon.
_FARTHEST_MOVE_M = 100.0


@dataclass(frozen=True)
class FocusAtDistance:
    metres: float


@dataclass(frozen=True)
class FocusAtPoint:
    x: float
    y: float


@dataclass(frozen=True)
class SetFNumber:
    f_number: float


@dataclass(frozen=True)
class Choose:
    """Choice by name. kind: "lens", "renderer" or "view"."""

    kind: str
    name: str


@dataclass(frozen=True)
class MoveObject:
    name: str
    xz_m: tuple[float, float]


@dataclass(frozen=True)
class ShowObject:
    name: str
    visible: bool


@dataclass(frozen=True)
class Capture:
    pass


@dataclass(frozen=True)
class Switch:
    """Something switched on or off. kind: "record" or "smoothing"."""

    kind: str
    on: bool


ControlMessage = FocusAtDistance | FocusAtPoint | SetFNumber | Choose | MoveObject | ShowObject | Capture | Switch


def control_message(value: Any) -> ControlMessage:
    """Return the message in a JSON value; InputError says what was expected where there is none."""
    if not isinstance(value, dict) or len(value) != 1:
        raise InputError(f"expected a JSON object with one of {', '.join(_VERBS)}, got {_shown(value)}")
    [(verb, content)] = value.items()
    if verb not in _VERBS:
        raise InputError(f"expected one of {', '.join(_VERBS)}, got {_shown(verb)}")
    return _VERBS[verb](content)


def _focus(content: Any) -> ControlMessage:
    match content:
        case {"distance_m": None, **rest} if not rest:
            return FocusAtDistance(math.inf)
        case {"distance_m": metres, **rest} if not rest:
            return FocusAtDistance(_number(metres, "distance_m", 0.0, math.inf))
        case {"at": [x, y], **rest} if not rest:
            return FocusAtPoint(_number(x, "x of at", 0.0, 1.0), _number(y, "y of at", 0.0, 1.0))
    raise InputError(f'expected focus as {{"distance_m": metres, or null for infinity}} or {{"at": [x, y]}}, got {_shown(content)}')


def _object(content: Any) -> ControlMessage:
    match content:
        case {"name": name, "move_m": [x, z], **rest} if not rest:
            farthest_m = _FARTHEST_MOVE_M
            return MoveObject(_name(name), (_number(x, "move_m", -farthest_m, farthest_m), _number(z, "move_m", -farthest_m, farthest_m)))
        case {"name": name, "visible": visible, **rest} if not rest:
            return ShowObject(_name(name), _truth(visible, "visible"))
    raise InputError(f'expected object as {{"name": ..., "move_m": [x, z]}} or {{"name": ..., "visible": true}}, got {_shown(content)}')


def _capture(content: Any) -> ControlMessage:
    if content != {}:
        raise InputError(f"expected capture as {{}}, got {_shown(content)}")
    return Capture()


def _number(value: Any, what: str, lowest: float, highest: float) -> float:
    """Return a finite number in a closed range; a truth value is none."""
    if isinstance(value, bool) or not isinstance(value, int | float) or not abs(value) < 1e12 or not lowest <= value <= highest:
        raise InputError(f"expected {what} as a number from {lowest:g} to {highest:g}, got {_shown(value)}")
    return float(value)


def _name(value: Any) -> str:
    if not isinstance(value, str) or not 0 < len(value) <= _LONGEST_NAME or not value.isprintable():
        raise InputError(f"expected a name of 1 to {_LONGEST_NAME} printable letters, got {_shown(value)}")
    return value


def _truth(value: Any, what: str) -> bool:
    if not isinstance(value, bool):
        raise InputError(f"expected {what} as true or false, got {_shown(value)}")
    return value


def _shown(value: Any) -> str:
    """Return what came, short enough for a sentence on a phone."""
    text = repr(value)
    return text if len(text) <= 60 else f"{text[:57]}..."


def _choose(kind: str) -> Callable[[Any], ControlMessage]:
    return lambda content: Choose(kind, _name(content))


def _switch(kind: str) -> Callable[[Any], ControlMessage]:
    return lambda content: Switch(kind, _truth(content, kind))


_VERBS: dict[str, Callable[[Any], ControlMessage]] = {
    "focus": _focus,
    "f_number": lambda content: SetFNumber(_number(content, "f_number", 0.1, 1000.0)),
    "lens": _choose("lens"),
    "renderer": _choose("renderer"),
    "view": _choose("view"),
    "object": _object,
    "capture": _capture,
    "record": _switch("record"),
    "smoothing": _switch("smoothing"),
}
