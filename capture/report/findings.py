"""What was found of a stack, in numbers: all that gates, charts and report.json need."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from capture.report.focus_curve import FocusCurve
from capture.report.focus_spacing import FocusSpacing, focus_spacing
from capture.report.neighbour_places import NeighbourPlace
from capture.report.picture_evidence import PictureFindings
from capture.report.registration_drift import RegistrationDrift, registration_drift
from capture.report.slice_fit import SliceFit
from capture.stacks.sentinel_focus import stated_by_sentinel
from mrbokeh.stacks.focal_stack import FocalStack
from mrbokeh.stacks.guessed_metres import STATED_DISTANCE


@dataclass(frozen=True)
class SliceFindings:
    """psnr_db: prediction against slice; unblurred_db: all-in-focus picture against slice (linear, clipped to 1, counted pixels).

    gain: brightness against the all-in-focus picture. What has None as its default is so where nothing can be predicted.
    """

    index: int
    gain: float
    saturated: float
    counted: float
    largest_coc_px: float | None = None
    psnr_db: float | None = None
    unblurred_db: float | None = None
    fit: SliceFit | None = None


@dataclass(frozen=True)
class StackFindings:
    """Findings of a merged stack at the width of the report.

    size_px, full_size_px: width and height of the pictures as examined and as stored. depth_off_share: of the pixels that tell, how many
    contradict depth by more than `stack_rules.DEPTH_OFF_PX`. moving_share: of the picture. Both are None where nothing can be predicted.
    picture: the all-in-focus picture beside its slices, at full size. pairs: how neighbouring slices lie.
    """

    stack: FocalStack
    size_px: tuple[int, int]
    full_size_px: tuple[int, int]
    slices: tuple[SliceFindings, ...]
    curve: FocusCurve
    depth_off_share: float | None
    moving_share: float | None
    picture: PictureFindings
    pairs: tuple[NeighbourPlace, ...]

    @property
    def name(self) -> str:
        return self.stack.folder.name

    @cached_property
    def spacing(self) -> FocusSpacing | None:
        """None where focus distances are not known."""
        if not self.stack.is_metric:
            return None
        calibrated = np.array([STATED_DISTANCE in each.metadata for each in self.stack.slices], bool)
        known = calibrated | ~stated_by_sentinel(self.stack)
        return focus_spacing([each for each in self.stack.focus_distances_m if each is not None], known)

    @cached_property
    def drift(self) -> RegistrationDrift | None:
        """None where the stack does not say how it was registered."""
        return registration_drift(self.stack, *self.full_size_px)
