"""A tethered camera through libgphoto2, its focus motor, and the list of connected cameras.

Nikon motors count steps and report their ends; Canon motors make steps of three sizes and report nothing. Both move only while
the live view runs and the lens is switched to autofocus, and neither reports its position. That Nikon's positive steps go to
infinity follows from Nikon's direction codes (1 to the closest focus, 2 to infinity), the first of which libgphoto2 uses for
negative numbers; no such camera was available for a test, hence `reverse`. Nikon also answers with the error of its ends if steps
are too small for a lens, or if the lens cannot be driven at all: libgphoto2 distinguishes these only in its messages.
"""

import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import PurePosixPath
from typing import Any, Protocol, TypeVar, runtime_checkable

import cv2
import numpy as np

from capture.photos.raw import RAW_SUFFIXES
from capture.tether.camera_driver import Ability, CameraDescription, CameraError, CameraSettings, EndStop, Preview, Shot, Stop
from capture.tether.gphoto2_config import FILE_FORMATS, FOCUS_DRIVE, CameraConfig, configure, explained, is_raw_only
from mrbokeh.system import gphoto2_library
from mrbokeh.system.gphoto2_library import NoCameraError, chosen_of, library, opened

LARGEST_NIKON_STEPS = 32767
# "Nikon manual focus at limit" and "stepping too small": the motor could not make its steps.
END_OF_TRAVEL = -113
BUSY = -110
_MOST_ATTEMPTS = 20
_ROUNDS_HOME = 4
# Canon tells no end: as many large steps as take any lens from one end to the other.
CANON_STEPS_HOME = 60
Sleep = Callable[[float], None]
_LIVE_VIEW_SWITCH = ("viewfinder", "eosviewfinder")
_LIVE_VIEW_SIGNS = (*_LIVE_VIEW_SWITCH, "liveviewsize", "liveviewimagequality", "evfmode")
_EVENT_WAIT_MS = 200
_MOST_EVENTS = 50
Answer = TypeVar("Answer")


@runtime_checkable
class FocusDrive(Protocol):
    """A motor that makes a number of its own steps, positive towards infinity, or drives to an end."""

    def step(self, steps: int) -> None: ...

    def home(self, stop: Stop) -> None: ...


class NikonFocusDrive:
    """Nikon's motor: manualfocusdrive is a number of steps, at most 32767 at a time."""

    def __init__(self, config: CameraConfig, *, reverse: bool = False, sleep: Sleep = time.sleep) -> None:
        self._config, self._sign, self._sleep = config, -1 if reverse else 1, sleep

    def step(self, steps: int) -> None:
        while steps:
            part = max(-LARGEST_NIKON_STEPS, min(LARGEST_NIKON_STEPS, steps))
            drive(self._config, float(part * self._sign), self._sleep)
            steps -= part

    def home(self, stop: Stop) -> None:
        try:
            for _ in range(_ROUNDS_HOME):
                self.step(-stop.away * LARGEST_NIKON_STEPS)
        except EndStop:
            return
        raise CameraError(f"the focus motor met no end towards {stop}: switch the lens to autofocus and release its focus lock")


class CanonFocusDrive:
    """Canon's motor: manualfocusdrive is "Near 1" to "Far 3"; repeating a word has no effect unless "None" comes between.

    level: the size of a step, 1 to 3. The sizes differ from lens to lens and are not multiples of one another, so only one of them
    is counted.
    """

    def __init__(self, config: CameraConfig, level: int = 1, *, reverse: bool = False, sleep: Sleep = time.sleep) -> None:
        self._config, self._level, self._reverse, self._sleep = config, level, reverse, sleep

    def step(self, steps: int) -> None:
        self._press(steps, self._level)

    def home(self, stop: Stop) -> None:
        try:
            self._press(-stop.away * CANON_STEPS_HOME, 3)
        except EndStop:
            return

    def _press(self, steps: int, level: int) -> None:
        word = f"{'Far' if (steps > 0) != self._reverse else 'Near'} {level}"
        for _ in range(abs(steps)):
            drive(self._config, word, self._sleep)
            drive(self._config, "None", self._sleep)


def focus_drive(config: CameraConfig, *, level: int = 1, reverse: bool = False, sleep: Sleep = time.sleep) -> FocusDrive | None:
    """Return the motor of this camera, or None if libgphoto2 knows none."""
    if config.first((FOCUS_DRIVE,)) is None:
        return None
    if any(each.startswith("Near") for each in config.choices(FOCUS_DRIVE)):
        return CanonFocusDrive(config, level, reverse=reverse, sleep=sleep)
    return NikonFocusDrive(config, reverse=reverse, sleep=sleep)


def drive(config: CameraConfig, value: object, sleep: Sleep) -> None:
    """Send one command to the motor, repeating it while the camera is busy. Raises EndStop at the end of the travel."""
    gp = library()
    for _ in range(_MOST_ATTEMPTS):
        try:
            config.set_raw(FOCUS_DRIVE, value)
            return
        except gp.GPhoto2Error as error:
            if error.code == END_OF_TRAVEL:
                raise EndStop from None
            if error.code != BUSY:
                with explained("driving the focus motor"):
                    raise
        sleep(0.1)
    raise CameraError("driving the focus motor failed: the camera stays busy; is its live view on and the lens in autofocus?")


class Gphoto2Camera:
    """A CameraDriver over libgphoto2.

    camera: a gphoto2.Camera, already initialised. focus_level: the size of Canon's steps. reverse_focus: swaps the motor's directions.
    """

    def __init__(
        self, camera: Any, port: str, *, focus_level: int = 1, reverse_focus: bool = False, sleep: Callable[[float], None] = time.sleep
    ) -> None:
        self._gp, self._camera, self._port, self._sleep = library(), camera, port, sleep
        self._config = CameraConfig(camera)
        self._drive: FocusDrive | None = focus_drive(self._config, level=focus_level, reverse=reverse_focus, sleep=sleep)
        self._steps: int | None = None
        self._live = False

    def describe(self) -> CameraDescription:
        with explained("asking the camera what it can do"):
            table = self._camera.get_abilities()
        can = {
            Ability.shutter: bool(table.operations & self._gp.GP_OPERATION_CAPTURE_IMAGE),
            Ability.focus_drive: self._drive is not None,
            Ability.live_view: bool(table.operations & self._gp.GP_OPERATION_CAPTURE_PREVIEW)
            and self._config.first(_LIVE_VIEW_SIGNS) is not None,
            Ability.raw: any(is_raw_only(each) for name in FILE_FORMATS for each in self._config.choices(name)),
        }
        return CameraDescription(str(table.model), self._port, frozenset(each for each, has in can.items() if has))

    def configure(self, settings: CameraSettings) -> dict[str, str]:
        return configure(self._config, settings)

    def preview(self) -> Preview:
        self._switch_live_view(True)
        file = self._patiently("the live view", self._camera.capture_preview)
        pixels = cv2.imdecode(np.frombuffer(_bytes_of(file), np.uint8), cv2.IMREAD_COLOR)
        if pixels is None:
            raise CameraError("the live view sent something that is no JPEG")
        return np.ascontiguousarray(pixels[..., ::-1])

    def focus_step(self, steps: int) -> None:
        self._require_drive().step(steps)
        self._steps = None if self._steps is None else self._steps + steps

    def home(self, stop: Stop) -> None:
        self._steps = None
        self._require_drive().home(stop)
        self._steps = 0

    def capture(self) -> Shot:
        """Release the shutter and return the RAW if one shot makes several files. They stay on the card, if they go there at all."""
        self._switch_live_view(False)
        path = self._patiently("taking a photograph", lambda: self._camera.capture(self._gp.GP_CAPTURE_IMAGE))
        found = [(path.folder, path.name), *self._files_added()]
        folder, name = next((each for each in found if PurePosixPath(each[1]).suffix.lower() in RAW_SUFFIXES), found[0])
        return Shot(self.download(folder, name), name, self._steps)

    def download(self, folder: str, name: str) -> bytes:
        """Return a whole file of the camera."""
        file = self._patiently(f"copying {name}", lambda: self._camera.file_get(folder, name, self._gp.GP_FILE_TYPE_NORMAL))
        return _bytes_of(file)

    def close(self) -> None:
        """Switch the live view off and release the camera, even if it is already unplugged."""
        try:
            self._switch_live_view(False)
            self._camera.exit()
        except (CameraError, self._gp.GPhoto2Error):
            pass

    def _require_drive(self) -> FocusDrive:
        if self._drive is None:
            raise CameraError("this camera's focus cannot be driven over the cable: turn the ring by hand (--by-hand)")
        self._switch_live_view(True)
        return self._drive

    def _switch_live_view(self, on: bool) -> None:
        """Switch the live view: motors and previews need it on, long transfers need it off."""
        name = self._config.first(_LIVE_VIEW_SWITCH)
        if name is not None and on != self._live:
            self._config.set(name, 1 if on else 0)
        self._live = on

    def _files_added(self) -> list[tuple[str, str]]:
        found = []
        for _ in range(_MOST_EVENTS):
            with explained("waiting for the camera"):
                kind, data = self._camera.wait_for_event(_EVENT_WAIT_MS)
            if kind == self._gp.GP_EVENT_FILE_ADDED:
                found.append((data.folder, data.name))
            elif kind in (self._gp.GP_EVENT_TIMEOUT, self._gp.GP_EVENT_CAPTURE_COMPLETE):
                break
        return found

    def _patiently(self, doing: str, ask: Callable[[], Answer]) -> Answer:
        """Ask again while the camera is busy, as it is right after a move or a shot."""
        for attempt in range(_MOST_ATTEMPTS):
            with explained(doing):
                try:
                    return ask()
                except self._gp.GPhoto2Error as error:
                    if error.code != BUSY or attempt == _MOST_ATTEMPTS - 1:
                        raise
            self._sleep(0.25)
        raise AssertionError("unreachable")


def _bytes_of(file: Any) -> bytes:
    return bytes(memoryview(file.get_data_and_size()))


@dataclass(frozen=True)
class FoundCamera:
    """A camera as libgphoto2 lists it. description: None if it could not be opened; `problem` says why."""

    model: str
    port: str
    description: CameraDescription | None = None
    problem: str = ""


def detected() -> list[tuple[str, str]]:
    """Return (model, port) of every connected camera."""
    with explained("looking for cameras"):
        return gphoto2_library.detected()


def list_cameras() -> list[FoundCamera]:
    """Describe every connected camera; each is opened and closed again."""
    cameras = []
    for model, port in detected():
        try:
            camera = open_camera(port)
        except CameraError as error:
            cameras.append(FoundCamera(model, port, problem=str(error)))
            continue
        try:
            cameras.append(FoundCamera(model, port, camera.describe()))
        finally:
            camera.close()
    return cameras


def open_camera(port: str | None = None, *, focus_level: int = 1, reverse_focus: bool = False) -> Gphoto2Camera:
    """Open the only camera, or the one at a port such as usb:001,005. Raises CameraError without one, InputError for several."""
    try:
        model, at = chosen_of(detected(), port, "--source")
    except NoCameraError as error:
        raise CameraError(str(error)) from None
    with explained(f"opening {model} at {at}"):
        return Gphoto2Camera(opened(at), at, focus_level=focus_level, reverse_focus=reverse_focus)
