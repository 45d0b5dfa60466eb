"""What one message of an external tracking system says, in our conventions."""

from dataclasses import dataclass

import numpy as np

from mrbokeh.tracking.camera_track.between_frames import focus_between_m, stop_between
from viewfinder.flow.frames import UNKNOWN_LENS, LensState, Pose

STAGE_FROM_BOARD = np.diag([1.0, -1.0, -1.0, 1.0])
"""Our world (x right, y down the board, z into it) lies on the stage's ground: y along -Y, z along -Z."""


class MalformedMessageError(ValueError):
    """A message from the network that is not what its format says; it is counted and otherwise ignored."""


@dataclass(frozen=True)
class TrackingSample:
    """camera_from_world: at the entrance pupil, our axes, metres. sender_s: when it was taken, by the sender's clock; None: not said.

    ignored: what the message says and nothing here makes use of.
    """

    camera_from_world: Pose
    lens: LensState = UNKNOWN_LENS
    sender_s: float | None = None
    ignored: frozenset[str] = frozenset()


def lens_between(a: LensState, b: LensState, share: float) -> LensState:
    """Focus in dioptres, f-numbers in stops: as the rings of a lens turn; what only one knows is taken from it."""
    a, b = a.completed_by(b), b.completed_by(a)
    both_mm = a.focal_length_mm, b.focal_length_mm
    return LensState(
        focus_between_m(a.focus_distance_m, b.focus_distance_m, share),
        stop_between(a.f_number, b.f_number, share),
        None if both_mm[0] is None or both_mm[1] is None else (1.0 - share) * both_mm[0] + share * both_mm[1],
    )
