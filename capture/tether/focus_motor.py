"""Repeatable positions of a focus motor that only counts steps, and the measurement of its scale.

Gears have play: after a reversal the first steps move nothing. A position is therefore always reached moving away from the stop.
To go back, the motor first goes `backlash_steps` too far, or to the stop again, and approaches from there.

The scale is measured by sweeping the focus over targets at known distances and finding the steps at which each is sharpest.
"""

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64

from capture.tether.camera_driver import CameraDriver, CameraError, EndStop, FocusSteps, Stop
from capture.tether.live_view import Spot, sharpness
from mrbokeh.system.errors import InputError

_MOST_POSITIONS = 2000
_LEVEL = 0.5
_HIGHEST_LEVEL = 0.9
_TINY = 1e-12


class TravelEndError(CameraError):
    """The motor met the far end of its travel."""


class FocusAxis:
    """Steps of a camera's focus motor, counted away from `stop`.

    backlash_steps: at least the play of the gears. settle_s: how long the lens swings after a move.
    """

    def __init__(
        self, camera: CameraDriver, stop: Stop, *, backlash_steps: int, settle_s: float = 0.5, sleep: Callable[[float], None] = time.sleep
    ) -> None:
        self._camera, self.stop, self._backlash_steps = camera, stop, backlash_steps
        self._settle_s, self._sleep = settle_s, sleep
        self._steps: int | None = None

    @property
    def steps(self) -> int | None:
        """Return the position in steps from the stop; None before the first homing."""
        return self._steps

    def home(self) -> None:
        self._steps = None
        self._camera.home(self.stop)
        self._steps = 0

    def move_to(self, target: int) -> None:
        """Go to `target` steps from the stop, arriving away from the stop, and wait until the lens has settled.

        Raises TravelEndError if the far end of the travel comes first.
        """
        if target < 0:
            raise CameraError(f"{-target} steps before the {self.stop} stop cannot be reached: plan a range that the lens has")
        if self._steps is None or target < self._steps:
            self._go_behind(target)
        self._drive(target - (self._steps or 0))
        self._sleep(self._settle_s)

    def _go_behind(self, target: int) -> None:
        if self._steps is None or target <= self._backlash_steps:
            self.home()
            return
        try:
            self._drive(target - self._backlash_steps - self._steps)
        except TravelEndError:
            # The stop came early, so the count was wrong: start it again.
            self.home()

    def _drive(self, steps: int) -> None:
        if steps == 0:
            return
        try:
            self._camera.focus_step(steps * self.stop.away)
        except EndStop:
            reached, self._steps = self._steps, None
            raise TravelEndError(
                f"the focus motor met its end between {reached} and {(reached or 0) + steps} steps from the {self.stop} stop: "
                f"plan a range that the lens has, or measure its steps again{'' if reached else ' (is the lens switched to autofocus?)'}"
            ) from None
        self._steps = (self._steps or 0) + steps


@dataclass(frozen=True)
class Target:
    """A detailed object at a known distance from the lens and at a known place in the picture."""

    spot: Spot
    distance_m: float

    def __str__(self) -> str:
        return f"the target at {self.spot.x:g},{self.spot.y:g} ({self.distance_m:g} m)"


@dataclass(frozen=True)
class FocusSweep:
    """Sharpness of each target over a sweep of the focus.

    steps: (P,) positions from the stop. sharpness: (T, P).
    """

    steps: Float64[np.ndarray, " positions"]
    sharpness: Float64[np.ndarray, "targets positions"]


def measure_focus_steps(
    axis: FocusAxis,
    camera: CameraDriver,
    targets: Sequence[Target],
    *,
    step: int,
    frames: int = 3,
) -> FocusSteps:
    """Return the scale of a motor from two or more targets at different distances. step: steps between two readings of the sweep.

    Raises InputError if a target is never sharp, or if their order does not fit the stop.
    """
    if len({target.distance_m for target in targets}) < 2:
        raise InputError(f"measuring the steps of a motor needs targets at two distances or more, got {len(targets)}: add a target")
    if not all(target.distance_m > 0.0 for target in targets) or step < 1:
        raise InputError(f"expected targets at positive distances and a positive step, got {[t.distance_m for t in targets]} m, {step}")
    sweep = sweep_focus(axis, camera, targets, step=step, frames=frames)
    found = [(peak_steps(sweep, index, target), 1.0 / target.distance_m) for index, target in enumerate(targets)]
    return FocusSteps(axis.stop, tuple(sorted(found)))


def sweep_focus(axis: FocusAxis, camera: CameraDriver, targets: Sequence[Target], *, step: int, frames: int) -> FocusSweep:
    """Read the sharpness from the stop to the other end of the travel, in the direction in which slices are approached."""
    axis.home()
    steps, values = [], []
    for position in range(_MOST_POSITIONS):
        if position:
            try:
                axis.move_to(position * step)
            except TravelEndError:
                # The far end of the travel: how far that is, nobody knows before.
                break
        previews = [camera.preview() for _ in range(frames)]
        steps.append(float(position * step))
        values.append([np.mean([sharpness(target.spot.cut(each)) for each in previews]) for target in targets])
    return FocusSweep(np.array(steps), np.array(values, np.float64).T.reshape(len(targets), len(steps)))


def peak_steps(sweep: FocusSweep, index: int, target: Target) -> float:
    """Return where one target is sharpest: the centroid of the part above half of its largest sharpness, weighted by the excess.

    A live view has few pixels, so the top of the curve is flat and its largest reading is noise; the slopes determine the middle.
    Near an end of the travel a higher level is used, so that both slopes lie within the sweep.
    """
    values = sweep.sharpness[index] / max(float(sweep.sharpness[index].max()), _TINY)
    top = int(np.argmax(values))
    level = max(_LEVEL, float(values[: top + 1].min()), float(values[top:].min()))
    if level > _HIGHEST_LEVEL:
        raise InputError(f"{target} is sharpest at the end of the focus travel: choose one within it, or correct its distance or place")
    below = np.flatnonzero(values <= level)
    first, last = int(below[below < top].max()), int(below[below > top].min())
    weights = np.maximum(values[first : last + 1] - level, 0.0)
    return float((weights * sweep.steps[first : last + 1]).sum() / weights.sum())
