"""A focus motor that only counts, made to return to the same place: from an end stop, always arriving in the same direction.

Gears have play: after turning round, the first steps move nothing. A place is therefore always reached moving away from the
stop. To go back, the motor first goes `backlash_steps` too far, or to the stop again, and comes forward from there.
"""

import time
from collections.abc import Callable

from capture.tether.camera_driver import CameraDriver, CameraError, EndStop
from capture.tether.focus_steps import Stop


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
        """Where the motor is, in steps from the stop; None before the first homing."""
        return self._steps

    def home(self) -> None:
        self._steps = None
        self._camera.home(self.stop)
        self._steps = 0

    def move_to(self, target: int) -> None:
        """Go to `target` steps from the stop, arriving away from the stop, and wait until the lens has settled.

        Raises TravelEndError where the far end of the travel comes before.
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
