"""How a bracket is shot, and what a shoot needs of the world around it."""

import time
from collections.abc import Callable
from dataclasses import dataclass, field
from datetime import datetime

from capture.tether.camera_driver import CameraSettings
from capture.tether.focus_steps import FocusSteps
from capture.tether.live_reading import Spot
from mrbokeh.system.errors import InputError


@dataclass(frozen=True)
class ShootOptions:
    """settings: fixed for all slices. focus_steps: the motor's scale; None asks the camera. by_hand: leave the motor alone.

    backlash_steps, settle_s: see FocusAxis. spot: where the live view's sharpness is read, None for the whole picture.
    check: shoot slice 0 again at the end.
    planned_distances: let lens.toml state the planned focus even where the photographs state their own.
    """

    settings: CameraSettings = field(default_factory=CameraSettings)
    focus_steps: FocusSteps | None = None
    by_hand: bool = False
    backlash_steps: int = 200
    settle_s: float = 0.5
    spot: Spot | None = None
    check: bool = True
    planned_distances: bool = False
    overwrite: bool = False


def _wait_for_enter(text: str) -> None:
    try:
        input(f"{text}. Enter when ready: ")
    except EOFError:
        raise InputError("turning the ring by hand needs somebody at the terminal who presses Enter") from None


@dataclass(frozen=True)
class Surroundings:
    """say: shows a line; ask: shows one and waits until the photographer is ready; sleep: waits some seconds; now: the time."""

    say: Callable[[str], None] = print
    ask: Callable[[str], None] = _wait_for_enter
    sleep: Callable[[float], None] = time.sleep
    now: Callable[[], datetime] = datetime.now
