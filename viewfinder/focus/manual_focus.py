"""ManualFocus: the focus that a person sets, with the slider or by a tap on something at a known depth."""

from dataclasses import replace

from mrbokeh.system.errors import InputError
from viewfinder.flow.frames import CameraFrame, LensState
from viewfinder.tracking.base import TrackedPose


class ManualFocus:
    """A FocusSource. What nobody has set (None) is not known here, and comes from who else knows it."""

    name = "by hand"

    def __init__(self, lens: LensState | None = None) -> None:
        self._lens = lens or LensState()

    def focus(self, distance_m: float | None) -> None:
        """Metres from the entrance pupil, inf is allowed; None hands the focus back to the other sources."""
        if distance_m is not None and not distance_m > 0.0:
            raise InputError(f"expected a focus distance of more than 0 m, got {distance_m} m")
        self._lens = replace(self._lens, focus_distance_m=distance_m)

    def set_f_number(self, f_number: float | None) -> None:
        """None hands it back to the other sources."""
        if f_number is not None and not 0.3 <= f_number <= 256.0:
            raise InputError(f"expected an f-number between 0.3 and 256, got {f_number}")
        self._lens = replace(self._lens, f_number=f_number)

    def state(self, frame: CameraFrame, pose: TrackedPose | None) -> LensState:  # noqa: ARG002
        return self._lens

    def close(self) -> None:
        """Nothing to close."""
