"""Choice between the two poses of a plane, and how sure it is: a hidden Markov chain over the frames.

In one frame noise may make the wrong pose fit better; the right one, however, moves from frame to frame as a camera does, and the
evidence of the frames adds up. States are the two poses of a frame. A frame's evidence is the likelihood of its corners; from frame to
frame the pose turns as a hand turns it (Rabiner 1989, forward and backward). If both poses come near one another, as when a board is
passed head on, the chain loses track of which is which, and says so until a frame tells them apart again.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from jaxtyping import Bool, Float64

from mrbokeh.tracking.charuco.pose_from_points import PlanePose, PlanePoses, Pose, turn_between_rad

CERTAIN_DEG = 3.0
"""RMS error of the rotation up to which a pose is shown."""

_RAD_PER_S = 1.0
_SWITCHES = 1e-5
"""Probability per frame that poses are exchanged whatever the motion."""

_INDEPENDENT = 0.2
"""Independent share of a frame's evidence: corners carried by flow, and the errors of a lens, are alike in frame after frame."""

Weights = Float64[np.ndarray, " poses"]


@dataclass(frozen=True)
class PoseFit:
    """Chosen pose of one frame.

    camera_from_world: (4, 4). residual_px: RMS distance over the inliers.

    turn_sigma_deg: RMS error of the rotation that is to be expected, of noise and of having taken the wrong one of two poses.
    """

    camera_from_world: Pose
    residual_px: float
    inliers: Bool[np.ndarray, " points"]
    turn_sigma_deg: float = 0.0

    @property
    def is_certain(self) -> bool:
        return self.turn_sigma_deg <= CERTAIN_DEG


class PoseBranches:
    """Choice of poses frame by frame as they come."""

    def __init__(self) -> None:
        self._before: PlanePoses | None = None
        self._weights, self._time_s = np.ones(1), 0.0
        self._shown: Pose | None = None

    def reset(self) -> None:
        """Forget the frames before: the next one has nothing to do with them."""
        self._before = self._shown = None

    def take(self, found: PlanePoses, time_s: float) -> PoseFit:
        """Return the likelier pose; while that is uncertain, the one nearer to the pose given before, so that nothing jumps for nothing."""
        weights = _evidence(found)
        if self._before is not None:
            weights = weights * (self._weights @ _transitions(self._before, found, time_s - self._time_s))
        self._before, self._weights, self._time_s = found, _normed(weights), time_s
        fit = _fit(found, self._weights, int(np.argmax(self._weights)))
        if not fit.is_certain and self._shown is not None:
            turned = [turn_between_rad(each.camera_from_world, self._shown) for each in found.poses]
            fit = _fit(found, self._weights, int(np.argmin(turned)))
        self._shown = fit.camera_from_world
        return fit


def fits_of_shot(found: Mapping[int, PlanePoses], times_s: Sequence[float]) -> dict[int, PoseFit]:
    """Choose the poses of a whole shot at once, using later frames for earlier ones. found: by frame; times_s: of all frames."""
    numbers = sorted(found)
    steps = [_transitions(found[one], found[other], times_s[other] - times_s[one]) for one, other in pairwise(numbers)]
    evidence = [_evidence(found[number]) for number in numbers]
    forward = evidence[:1]
    for step, new in zip(steps, evidence[1:], strict=True):
        forward.append(_normed(new * (forward[-1] @ step)))
    backward = [np.ones(len(each)) for each in evidence]
    for index in range(len(steps) - 1, -1, -1):
        backward[index] = _normed(steps[index] @ (evidence[index + 1] * backward[index + 1]))
    weights = [_normed(one * other) for one, other in zip(forward, backward, strict=True)]
    return {number: _fit(found[number], each, int(np.argmax(each))) for number, each in zip(numbers, weights, strict=True)}


def _evidence(found: PlanePoses) -> Weights:
    """Return tempered likelihoods."""
    misfits = np.array([each.misfit for each in found.poses])
    return _normed(np.exp(-0.5 * _INDEPENDENT * (misfits - misfits.min())))


def _transitions(one: PlanePoses, other: PlanePoses, elapsed_s: float) -> Float64[np.ndarray, "before after"]:
    """Return transition probabilities; rows sum to 1."""
    likely = np.array([[_likely(a, b, elapsed_s) for b in other.poses] for a in one.poses]) + _SWITCHES
    return likely / likely.sum(axis=1, keepdims=True)


def _likely(one: PlanePose, other: PlanePose, elapsed_s: float) -> float:
    variance = (_RAD_PER_S * elapsed_s) ** 2 + one.turn_sigma_rad**2 + other.turn_sigma_rad**2
    return float(np.exp(-0.5 * turn_between_rad(one.camera_from_world, other.camera_from_world) ** 2 / variance))


def _fit(found: PlanePoses, weights: Weights, chosen: int) -> PoseFit:
    pose = found.poses[chosen]
    turned = np.array([turn_between_rad(each.camera_from_world, pose.camera_from_world) for each in found.poses])
    sigma_rad = np.sqrt(pose.turn_sigma_rad**2 + weights @ turned**2)
    return PoseFit(pose.camera_from_world, pose.residual_px, found.inliers, float(np.rad2deg(sigma_rad)))


def _normed(weights: Weights) -> Weights:
    """Normalise weights, never quite to 0: what was ruled out once may turn out to be right."""
    return np.maximum(weights / weights.sum(), 1e-12)
