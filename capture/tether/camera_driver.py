"""What every tethered camera can be asked for, whatever stands behind it."""

from dataclasses import dataclass
from enum import StrEnum
from typing import Protocol, runtime_checkable

import numpy as np
from jaxtyping import UInt8

from capture.tether.focus_steps import FocusSteps, Stop
from mrbokeh.system.errors import InputError

Preview = UInt8[np.ndarray, "height width 3"]


class CameraError(InputError):
    """The camera did not answer, or answered that it cannot. What was shot before is kept."""


class EndStop(Exception):  # noqa: N818 - it tells where the lens is, and is no error while homing
    """The focus motor met the end of its travel before it had made all the steps."""


class Ability(StrEnum):
    shutter = "shutter"
    focus_drive = "focus drive"
    live_view = "live view"
    raw = "RAW"


@dataclass(frozen=True)
class CameraDescription:
    """name: the model; port: where it is connected. focus_steps: where a camera knows what its steps mean."""

    name: str
    port: str
    abilities: frozenset[Ability]
    focus_steps: FocusSteps | None = None


@dataclass(frozen=True)
class CameraSettings:
    """What stays the same in all slices; None keeps what the camera has.

    exposure_time_s: seconds; white_balance: a word of the camera's own list, such as "Daylight", that is not automatic.
    """

    exposure_time_s: float | None = None
    iso: float | None = None
    f_number: float | None = None
    white_balance: str | None = None


@dataclass(frozen=True)
class Shot:
    """One photograph as the camera's file. name: the camera's own name for it. steps: its step counter, None without motor."""

    data: bytes
    name: str
    steps: int | None = None


@runtime_checkable
class CameraDriver(Protocol):
    """A camera on a cable, in a folder or in memory. All methods raise CameraError where the camera fails.

    Counted steps are positive towards infinity. What an ability is missing for raises CameraError, too.
    """

    def describe(self) -> CameraDescription: ...

    def configure(self, settings: CameraSettings) -> dict[str, str]:
        """Manual exposure, RAW, a fixed white balance, autofocus off, as far as it can; what is set now, by name.

        Raises InputError where the exposure would stay automatic.
        """
        ...

    def preview(self) -> Preview:
        """One frame of the live view, encoded for display (sRGB)."""
        ...

    def focus_step(self, steps: int) -> None:
        """Drive the focus motor; positive goes to infinity. Raises EndStop where it cannot make all of the steps."""
        ...

    def home(self, stop: Stop) -> None:
        """Drive against an end stop and count from there: the step counter is 0."""
        ...

    def capture(self) -> Shot:
        """Release the shutter (or wait for the photographer) and take over the whole file."""
        ...

    def close(self) -> None: ...
