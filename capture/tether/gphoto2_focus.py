"""Focus motors over libgphoto2: Nikon counts steps and reports its ends, Canon makes steps of three sizes and reports nothing.

Both move only while the live view runs and the lens is switched to autofocus. Neither tells where it is. That Nikon's positive
steps go to infinity follows from Nikon's direction codes (1 to the closest focus, 2 to infinity), of which libgphoto2 takes the
first for negative numbers; no such camera was at hand to see it, hence `reverse`. Nikon answers with the error of its ends
also when steps are too small for a lens, or when it does not let itself be driven at all: libgphoto2 tells these apart only in
its messages.
"""

import time
from collections.abc import Callable
from typing import Protocol, runtime_checkable

from capture.tether.camera_driver import CameraError, EndStop
from capture.tether.focus_steps import Stop
from capture.tether.gphoto2_config import CameraConfig
from capture.tether.gphoto2_errors import explained
from capture.tether.gphoto2_settings import FOCUS_DRIVE
from mrbokeh.system.gphoto2_library import library

LARGEST_NIKON_STEPS = 32767
# "Nikon manual focus at limit" and "stepping too small": the motor could not make its steps.
END_OF_TRAVEL = -113
BUSY = -110
_MOST_ATTEMPTS = 20
_ROUNDS_HOME = 4
# Canon tells no end: as many large steps as take any lens from one end to the other.
CANON_STEPS_HOME = 60
Sleep = Callable[[float], None]


@runtime_checkable
class FocusDrive(Protocol):
    """A motor that goes a number of its own steps, positive towards infinity, and to an end."""

    def step(self, steps: int) -> None: ...

    def home(self, stop: Stop) -> None: ...


class NikonFocusDrive:
    """manualfocusdrive is a number of steps, at most 32767 at a time."""

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
    """manualfocusdrive is "Near 1" to "Far 3"; the same word twice moves once unless "None" comes between.

    level: the size of a step, 1 to 3. The sizes differ from lens to lens and are no multiples of one another, so that only
    one of them is counted.
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
    """The motor of this camera, or None where libgphoto2 knows none."""
    if config.first((FOCUS_DRIVE,)) is None:
        return None
    if any(each.startswith("Near") for each in config.choices(FOCUS_DRIVE)):
        return CanonFocusDrive(config, level, reverse=reverse, sleep=sleep)
    return NikonFocusDrive(config, reverse=reverse, sleep=sleep)


def drive(config: CameraConfig, value: object, sleep: Sleep) -> None:
    """One command to the motor, again while the camera is busy. Raises EndStop at the end of the travel."""
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
