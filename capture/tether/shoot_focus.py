"""How a slice comes into focus: by the camera's motor, or by the photographer's hand."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

from capture.tether.focus_axis import FocusAxis
from capture.tether.focus_plan import FocusPlan
from capture.tether.focus_steps import FocusSteps
from mrbokeh.optics.lens import film_plane_m


@runtime_checkable
class Focusing(Protocol):
    def focus_on(self, index: int) -> float:
        """Focus as the slice needs it; the dioptres reached, as far as known. Raises CameraError where it cannot be reached."""
        ...


@dataclass(frozen=True)
class ByMotor:
    """Whole steps of a motor, so that the focus is up to half a step off the plan."""

    plan: FocusPlan
    axis: FocusAxis
    steps: FocusSteps

    def focus_on(self, index: int) -> float:
        wanted = self.steps.steps_at(self.plan.dioptres[index])
        self.axis.move_to(wanted)
        return max(self.steps.dioptre_at(wanted), 0.0)


@dataclass(frozen=True)
class ByHand:
    """The photographer turns the ring; `ask` shows what to do and returns when it is done."""

    plan: FocusPlan
    ask: Callable[[str], None]

    def focus_on(self, index: int) -> float:
        lens = self.plan.lenses[index]
        self.ask(
            f"slice {index} of 0 to {len(self.plan) - 1}: focus at {film_plane_m(lens):.3f} m on the lens's scale "
            f"({lens.focus_distance_m:.3f} m from the lens), always turning from near to far"
        )
        return self.plan.dioptres[index]
