"""Controls: what a page may ask of the viewfinder; Dispatcher: carries it out, whichever way it came, one message at a time."""

import asyncio
import logging
from concurrent.futures import ThreadPoolExecutor
from typing import Any, Protocol, TypedDict, runtime_checkable

from mrbokeh.system.errors import InputError
from viewfinder.frames import finite
from viewfinder.server.access import LARGEST_MESSAGE, json_value
from viewfinder.server.control_messages import (
    Capture,
    Choose,
    ControlMessage,
    FocusAtDistance,
    FocusAtPoint,
    MoveObject,
    SetFNumber,
    ShowObject,
    Switch,
    control_message,
)
from viewfinder.server.sessions import RateLimit, Role

VIEWS = ("final", "plate", "virtual", "matte", "depth", "coc")


class ObjectState(TypedDict):
    """Object of the scene, by the name under which messages call it."""

    name: str
    visible: bool


class State(TypedDict, total=False):
    """State that the page shows; what is missing is not offered. Distances in metres, None is infinity.

    dioptre_range: the ends of the focus slider, (far, near), 1/m. focus_from: who told the focus, None where nobody did and the lens's
    file holds. f_numbers: what may be set, ascending. lens, renderer, view: which of
    lenses, renderers, views is on. ground_from_picture: (3, 3) homography from the picture (x right, y down, 0 to 1) to metres on the
    plane on which objects stand, (x, z) of `move_object`, as nested lists; None while nothing is tracked. can_record, can_capture: whether
    the buttons are shown. failure: a sentence if the source died.
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
    smoothing: bool | None
    failure: str | None


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
