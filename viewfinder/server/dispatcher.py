"""Dispatcher: carries out control messages, whichever way they came (POST, WebSocket, data channel), one at a time."""

import asyncio
import logging
from concurrent.futures import ThreadPoolExecutor
from typing import Any

from mrbokeh.system.errors import InputError
from viewfinder.flow.frame_header import finite
from viewfinder.server.bounded import LARGEST_MESSAGE, json_value
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
from viewfinder.server.controls import Controls, State
from viewfinder.server.rate_limit import RateLimit
from viewfinder.server.sessions import Role

_MOST_WAITING = 8

log = logging.getLogger(__name__)


class Dispatcher:
    """Lives in the event loop; the controls are called in one thread, so that a slow one holds up no picture."""

    def __init__(self, controls: Controls) -> None:
        self.controls = controls
        self._thread = ThreadPoolExecutor(1, thread_name_prefix="controls")
        self._waiting = 0
        self._limit = RateLimit(per_s=40.0, burst=80.0)

    async def answer(self, text: str | bytes, role: Role, address: str) -> dict[str, Any]:
        """{"done": verb, ...} or {"error": sentence}, after which nothing has changed. address: of the sender, for the rate limit."""
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
        """Does not wait for a control that hangs."""
        self._thread.shutdown(wait=False, cancel_futures=True)


def perform(message: ControlMessage, controls: Controls) -> dict[str, Any]:
    """Call the control that a message asks for; the answer to it. Names must be among those that the state lists."""
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
    """No name that the viewfinder did not offer goes any further: a page cannot smuggle in a path."""
    if name not in names:
        raise InputError(f"there is no {kind} {name!r}: choose one of {', '.join(names) or 'none, for there is none'}")
    return name
