"""A focus motor with what makes real ones hard: it counts nothing, its gears have play, and its travel ends."""

from dataclasses import dataclass

from capture.tether.camera_driver import EndStop
from capture.tether.focus_steps import FocusSteps, Stop


@dataclass
class SimulatedMotor:
    """A gear that pushes a lens; the lens lies up to `backlash_steps` behind the gear.

    travel_steps: of the lens, from its near stop (0) to infinity. The focus changes evenly in dioptres, from
    nearest_dioptre to 0. gear, lens: where both are; a motor that was switched on may stand anywhere.
    """

    nearest_dioptre: float
    travel_steps: int = 2400
    backlash_steps: int = 40
    lens: float = 900.0
    gear: float = 920.0

    @property
    def dioptre(self) -> float:
        """In focus, from the lens; 0 is infinity."""
        return self.nearest_dioptre * (1.0 - self.lens / self.travel_steps)

    @property
    def focus_steps(self) -> FocusSteps:
        """The scale as it shows when one counts from the near stop and moves away from it: the play comes first."""
        far = self.backlash_steps + self.travel_steps
        return FocusSteps(Stop.near, ((float(self.backlash_steps), self.nearest_dioptre), (float(far), 0.0)))

    def drive(self, steps: int) -> None:
        """Positive is towards infinity. Raises EndStop where a stop was met on the way."""
        self.gear += steps
        # The gear takes the lens along forwards once the play is used up, backwards at its front face.
        self.lens = min(max(self.lens, self.gear - self.backlash_steps), self.gear)
        if not 0 <= self.lens <= self.travel_steps:
            at_near = self.lens < 0
            self.lens = 0.0 if at_near else float(self.travel_steps)
            self.gear = self.lens if at_near else self.lens + self.backlash_steps
            raise EndStop

    def bump(self, steps: float) -> None:
        """Somebody touches the ring: the lens slips on its gear."""
        self.lens = min(max(self.lens + steps, 0.0), float(self.travel_steps))
        self.gear = min(max(self.gear, self.lens), self.lens + self.backlash_steps)
