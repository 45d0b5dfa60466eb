"""The driver protocol of tethered cameras, and the scale of their focus motors.

Cameras move their motors by steps and do not report a position. Counted from an end stop the steps are repeatable, and dioptres
grow linearly with the extension of a thin lens. Two known distances therefore give the whole scale; more of them make it
piecewise linear.

    {"format": "mrbokeh-focus-steps", "version": 1, "stop": "near", "points": [[180, 2.0], [1450, 0.5]]}
"""

from dataclasses import dataclass
from enum import StrEnum
from itertools import pairwise
from pathlib import Path
from typing import Any, Protocol, runtime_checkable

import numpy as np
from jaxtyping import UInt8

from mrbokeh.system.atomic_files import read_json, write_json
from mrbokeh.system.errors import InputError

FORMAT = "mrbokeh-focus-steps"
VERSION = 1
Preview = UInt8[np.ndarray, "height width 3"]


class Stop(StrEnum):
    """The two ends of a lens's focus travel."""

    near = "near"
    infinity = "infinity"

    @property
    def away(self) -> int:
        """Return the sign of steps that lead away from this stop; + is towards infinity."""
        return 1 if self is Stop.near else -1


@dataclass(frozen=True)
class FocusSteps:
    """The scale of a focus motor, measured while moving away from the stop only, so that play is part of it.

    points: (steps away from the stop, dioptres from the lens), at least two, in the order of their steps.
    """

    stop: Stop
    points: tuple[tuple[float, float], ...]

    def __post_init__(self) -> None:
        rising = [after[0] > before[0] and (after[1] - before[1]) * self.stop.away < 0.0 for before, after in pairwise(self.points)]
        if len(self.points) < 2 or not all(rising):
            raise InputError(
                f"steps from the {self.stop} stop need at least two points, each farther from it than the one before, "
                f"in steps and in focus, got {[tuple(each) for each in self.points]} (steps, dioptres)"
            )

    def steps_at(self, dioptre: float) -> int:
        """Return whole steps from the stop; beyond the points the nearest segment is extrapolated."""
        steps, dioptres = np.array(self.points).T
        return round(_piecewise(dioptre * -self.stop.away, dioptres * -self.stop.away, steps))

    def dioptre_at(self, steps: int) -> float:
        known, dioptres = np.array(self.points).T
        return _piecewise(float(steps), known, dioptres)

    @property
    def dioptres_per_step(self) -> float:
        """Return the mean over the points, positive."""
        (first, start), (last, end) = self.points[0], self.points[-1]
        return abs(end - start) / (last - first)


def _piecewise(x: float, known_x: np.ndarray, known_y: np.ndarray) -> float:
    """Interpolate linearly between the points and extrapolate the outer segments; known_x rises."""
    segment = int(np.clip(np.searchsorted(known_x, x) - 1, 0, len(known_x) - 2))
    (x0, x1), (y0, y1) = known_x[segment : segment + 2], known_y[segment : segment + 2]
    return float(y0 + (x - x0) * (y1 - y0) / (x1 - x0))


def steps_to_json(steps: FocusSteps) -> dict[str, Any]:
    return {"format": FORMAT, "version": VERSION, "stop": str(steps.stop), "points": [list(each) for each in steps.points]}


def write_focus_steps(path: Path, steps: FocusSteps) -> None:
    write_json(path, steps_to_json(steps))


def read_focus_steps(path: Path) -> FocusSteps:
    document = read_json(path, "the scale of a focus motor (focus_steps.json)")
    return steps_from_json(document, str(path))


def steps_from_json(document: Any, where: str) -> FocusSteps:
    if not isinstance(document, dict) or (document.get("format"), document.get("version")) != (FORMAT, VERSION):
        raise InputError(f"{where}: expected the scale of a focus motor, format {FORMAT!r}, version {VERSION}")
    try:
        points = tuple((float(steps), float(dioptre)) for steps, dioptre in document["points"])
        return FocusSteps(Stop(document["stop"]), points)
    except (KeyError, TypeError, ValueError) as error:
        raise error if isinstance(error, InputError) else InputError(f"{where}: this scale is damaged ({error!r})") from None


class CameraError(InputError):
    """The camera did not answer, or refused. Everything shot before is kept."""


class EndStop(Exception):  # noqa: N818 - it tells where the lens is, and is no error while homing
    """The focus motor met the end of its travel before it had made all the steps."""


class Ability(StrEnum):
    shutter = "shutter"
    focus_drive = "focus drive"
    live_view = "live view"
    raw = "RAW"


@dataclass(frozen=True)
class CameraDescription:
    """A camera and its abilities.

    name: the model. port: where it is connected. focus_steps: the scale of its motor, None if the camera does not know it.
    """

    name: str
    port: str
    abilities: frozenset[Ability]
    focus_steps: FocusSteps | None = None


@dataclass(frozen=True)
class CameraSettings:
    """Settings shared by all slices; None keeps the camera's own.

    exposure_time_s: seconds. white_balance: one of the camera's own words, such as "Daylight", and not automatic.
    """

    exposure_time_s: float | None = None
    iso: float | None = None
    f_number: float | None = None
    white_balance: str | None = None


@dataclass(frozen=True)
class Shot:
    """One photograph as the camera's file. name: the camera's own name for it. steps: its step counter, None without a motor."""

    data: bytes
    name: str
    steps: int | None = None


@runtime_checkable
class CameraDriver(Protocol):
    """A camera on a cable, in a folder or in memory. All methods raise CameraError if the camera fails or lacks the ability.

    Counted steps are positive towards infinity.
    """

    def describe(self) -> CameraDescription: ...

    def configure(self, settings: CameraSettings) -> dict[str, str]:
        """Set manual exposure, RAW, a fixed white balance and autofocus off as far as possible; return what is set now, by name.

        Raises InputError if the exposure would stay automatic.
        """
        ...

    def preview(self) -> Preview:
        """Return one frame of the live view, encoded for display (sRGB)."""
        ...

    def focus_step(self, steps: int) -> None:
        """Drive the focus motor; positive goes to infinity. Raises EndStop if it cannot make all of the steps."""
        ...

    def home(self, stop: Stop) -> None:
        """Drive against an end stop and reset the step counter to 0 there."""
        ...

    def capture(self) -> Shot:
        """Release the shutter (or wait for the photographer) and return the whole file."""
        ...

    def close(self) -> None: ...
