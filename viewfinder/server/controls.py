"""Controls: what a page may ask of the viewfinder; Dispatcher: carries it out, whichever way it came, one message at a time.

A message is typed, and checked before anything changes. It is one JSON object with one verb:
{"focus": {"distance_m": 2.5 or null}}, {"focus": {"at": [x, y]}}, {"f_number": 2.0}, {"lens": name},
{"renderer": name}, {"view": name}, {"object": {"name": name, "move_m": [x, z]}}, {"object": {"name": name, "visible": true}},
{"capture": {}}, {"record": true}, {"smoothing": true}.
"""

import asyncio
import logging
import math
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any, Protocol, TypedDict, runtime_checkable

from mrbokeh.system.errors import InputError
from viewfinder.frames import RemarkJson, finite
from viewfinder.server.access import LARGEST_MESSAGE, json_value
from viewfinder.server.sessions import RateLimit, Role

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


def _choice(kind: str) -> Callable[[Any], ControlMessage]:
    return lambda content: Choose(kind, _name(content))


def _switch(kind: str) -> Callable[[Any], ControlMessage]:
    return lambda content: Switch(kind, _truth(content, kind))


_VERBS: dict[str, Callable[[Any], ControlMessage]] = {
    "focus": _focus,
    "f_number": lambda content: SetFNumber(_number(content, "f_number", 0.1, 1000.0)),
    "lens": _choice("lens"),
    "renderer": _choice("renderer"),
    "view": _choice("view"),
    "object": _object,
    "capture": _capture,
    "record": _switch("record"),
    "smoothing": _switch("smoothing"),
}


VIEWS = ("final", "plate", "virtual", "matte", "depth", "coc")


class ObjectState(TypedDict):
    """Object of the scene, by the name under which messages call it."""

    name: str
    visible: bool


class Notice(TypedDict):
    """Notice of something that happened by itself; numbers grow, so that a page shows each once."""

    number: int
    sentence: str


class State(TypedDict, total=False):
    """State that the page shows; what is missing is not offered. Distances in metres, None is infinity.

    dioptre_range: the ends of the focus slider, (far, near), 1/m. focus_from: who told the focus, None where nobody did and the lens's
    file holds. f_numbers: what may be set, ascending. lens, renderer, view: which of
    lenses, renderers, views is on. ground_from_picture: (3, 3) homography from the picture (x right, y down, 0 to 1) to metres on the
    plane on which objects stand, (x, z) of `move_object`, as nested lists; None while nothing is tracked. can_record, can_capture: whether
    the buttons are shown. recorded_s: of the take under way; room_s: how much longer the disk will do. failure: a sentence if the source
    died. remark: why nothing virtual is in the newest picture, or that it is old.
    """

    source: str
    width_px: int
    height_px: int
    dioptre_range: tuple[float, float]
    focus_distance_m: float | None
    focus_from: str | None
    f_number: float
    f_numbers: list[float]
    lens: str
    lenses: list[str]
    renderer: str
    renderers: list[str]
    view: str
    views: list[str]
    objects: list[ObjectState]
    ground_from_picture: list[list[float]] | None
    can_capture: bool
    can_record: bool
    recording: bool
    recorded_s: float | None
    room_s: float | None
    notices: list[Notice]
    smoothing: bool | None
    failure: str | None
    remark: RemarkJson | None


@runtime_checkable
class Controls(Protocol):
    """Controls of a viewfinder. All but `state` are called one at a time in a thread of their own; InputError says what cannot be."""

    def focus_at_distance(self, metres: float) -> None:
        """Focus at so many metres; inf is allowed."""

    def focus_at_point(self, x: float, y: float) -> float:
        """Focus on what the picture shows at (x, y), right and down from 0 to 1; return the metres found."""
        ...

    def set_f_number(self, f_number: float) -> None: ...

    def set_lens(self, name: str) -> None: ...

    def set_renderer(self, name: str) -> None: ...

    def set_view(self, name: str) -> None: ...

    def move_object(self, name: str, xz_m: tuple[float, float]) -> None:
        """Move an object by so many metres on the ground plane."""

    def show_object(self, name: str, visible: bool) -> None: ...

    def capture(self) -> str:
        """Save what is seen now; return the name of the bundle."""
        ...

    def record(self, on: bool) -> None: ...

    def smooth(self, on: bool) -> None: ...

    def state(self) -> State:
        """Return at once, from any thread."""
        ...


_MOST_WAITING = 8

log = logging.getLogger(__name__)


class Dispatcher:
    """Dispatcher in the event loop; the controls are called in one thread, so that a slow one holds up no picture."""

    def __init__(self, controls: Controls) -> None:
        self.controls = controls
        self._thread = ThreadPoolExecutor(1, thread_name_prefix="controls")
        self._waiting = 0
        self._limit = RateLimit(per_s=40.0, burst=80.0)

    async def answer(self, text: str | bytes, role: Role, address: str) -> dict[str, Any]:
        """Answer {"done": verb, ...}, or {"error": sentence}, after which nothing has changed. address: of the sender, for its limit."""
        try:
            return await self._answer(text, role, address)
        except InputError as problem:
            return {"error": str(problem)}
        except Exception:
            log.exception("a control message could not be carried out")
            return {"error": "this failed in the viewfinder; see its terminal"}

    async def _answer(self, text: str | bytes, role: Role, address: str) -> dict[str, Any]:
        if role < Role.CONTROL:
            raise InputError("you may watch but not control: open the address for control that the viewfinder printed")
        if not self._limit.allows(address):
            raise InputError("too many messages from this address: wait a moment")
        if len(text) > LARGEST_MESSAGE:
            raise InputError(f"expected a message of at most {LARGEST_MESSAGE} bytes, got {len(text)}")
        message = control_message(json_value(text))
        if self._waiting >= _MOST_WAITING:
            raise InputError("the viewfinder is still busy with what it was asked before: wait a moment")
        self._waiting += 1
        try:
            return await asyncio.get_running_loop().run_in_executor(self._thread, perform, message, self.controls)
        finally:
            self._waiting -= 1

    def close(self) -> None:
        """Close without waiting for a control that hangs."""
        self._thread.shutdown(wait=False, cancel_futures=True)


def perform(message: ControlMessage, controls: Controls) -> dict[str, Any]:
    """Call the control that a message asks for; return the answer. Names must be among those that the state lists."""
    state = controls.state()
    match message:
        case FocusAtDistance(metres):
            controls.focus_at_distance(metres)
        case FocusAtPoint(x, y):
            return {"done": "focus", "focus_distance_m": finite(controls.focus_at_point(x, y))}
        case SetFNumber(f_number):
            controls.set_f_number(f_number)
        case Choose(kind, name):
            _choose(controls, state, kind, name)
        case MoveObject(name, xz_m):
            controls.move_object(_known(name, _object_names(state), "object"), xz_m)
        case ShowObject(name, visible):
            controls.show_object(_known(name, _object_names(state), "object"), visible)
        case Capture():
            return {"done": "capture", "bundle": controls.capture()}
        case Switch(kind, on):
            (controls.record if kind == "record" else controls.smooth)(on)
    return {"done": _DONE.get(type(message)) or getattr(message, "kind", "object")}


_DONE: dict[type, str] = {FocusAtDistance: "focus", SetFNumber: "f_number"}


def _choose(controls: Controls, state: State, kind: str, name: str) -> None:
    names = {"lens": state.get("lenses", []), "renderer": state.get("renderers", []), "view": state.get("views", [])}[kind]
    {"lens": controls.set_lens, "renderer": controls.set_renderer, "view": controls.set_view}[kind](_known(name, names, kind))


def _object_names(state: State) -> list[str]:
    return [each["name"] for each in state.get("objects", [])]


def _known(name: str, names: list[str], kind: str) -> str:
    """Return a name that the viewfinder offered: a page cannot smuggle in a path."""
    if name not in names:
        raise InputError(f"there is no {kind} {name!r}: choose one of {', '.join(names) or 'none, for there is none'}")
    return name
