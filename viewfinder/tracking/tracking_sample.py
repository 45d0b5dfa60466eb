"""What one message of an external tracking system says, in our conventions."""

import math
from dataclasses import dataclass

from viewfinder.frames import UNKNOWN_LENS, LensState, Pose


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
    dioptres = _line(_inverse(a.focus_distance_m), _inverse(b.focus_distance_m), share)
    stops = _line(_logarithm(a.f_number), _logarithm(b.f_number), share)
    return LensState(
        _inverse(dioptres),
        None if stops is None else math.exp(stops),
        _line(a.focal_length_mm, b.focal_length_mm, share),
    )


def _line(a: float | None, b: float | None, share: float) -> float | None:
    return None if a is None or b is None else (1.0 - share) * a + share * b


def _inverse(value: float | None) -> float | None:
    """Metres to dioptres and back; the inverse of 0 is inf."""
    if value is None:
        return None
    return 1.0 / value if value > 0.0 else math.inf


def _logarithm(value: float | None) -> float | None:
    return None if value is None else math.log(value)
