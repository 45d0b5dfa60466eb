"""1-Euro filter (Casiez, Roussel and Vogel, CHI 2012) for poses: steady while the camera rests, quick while it moves.

Angles and speeds are in degrees and degrees per second. A shift of the board counts as the angle under which the camera sees it,
so that one cutoff serves turn and shift: filtered apart, they would let the object swim on the board.

SmoothedTracker can be switched off, and then poses pass as they are: a pose solved from the frame it is shown over needs no smoothing,
and any smoothing makes the object lag behind the plate.
"""

from dataclasses import replace

import numpy as np
from jaxtyping import Float64
from scipy.spatial.transform import Rotation

from mrbokeh.optics.camera import Camera
from viewfinder.frames import CameraFrame, Pose
from viewfinder.tracking.tracker import TrackedPose, Tracker

SLOWEST_HZ = 0.5
QUICKENING = 1.0
_SPEED_HZ = 1.0

Six = Float64[np.ndarray, "6"]


class OneEuroPose:
    """Filter of poses.

    slowest_hz: cutoff at rest. quickening: Hz that each degree per second adds. pivot_m: the world point whose shift is filtered.
    """

    def __init__(
        self, slowest_hz: float = SLOWEST_HZ, quickening: float = QUICKENING, pivot_m: tuple[float, float, float] = (0.0, 0.0, 0.0)
    ) -> None:
        self._slowest_hz, self._quickening, self._pivot_m = slowest_hz, quickening, np.asarray(pivot_m)
        self.reset()

    def reset(self) -> None:
        """Forget: the next pose is given as it comes."""
        self._turn: Rotation | None = None
        self._raw_turn, self._place, self._raw_place = Rotation.identity(), np.zeros(3), np.zeros(3)
        self._speed: Six = np.zeros(6)
        self._time_s = 0.0

    def __call__(self, camera_from_world: Pose, time_s: float) -> Pose:
        """Filter a pose in; time_s must grow: one of the same time as the one before, or an older one, is not filtered in."""
        turn = Rotation.from_matrix(camera_from_world[:3, :3])
        place = turn.apply(self._pivot_m) + camera_from_world[:3, 3]
        step_s = time_s - self._time_s
        if self._turn is None:
            self._turn, self._raw_turn, self._place, self._raw_place, self._time_s = turn, turn, place, place, time_s
        elif step_s > 0.0:
            self._filter(turn, place, step_s)
            self._time_s = time_s
        return self._pose()

    def _filter(self, turn: Rotation, place: Float64[np.ndarray, "3"], step_s: float) -> None:
        assert self._turn is not None
        turned_deg = (turn * self._raw_turn.inv()).as_rotvec(degrees=True)
        shifted_deg = np.rad2deg((place - self._raw_place) / np.linalg.norm(place))
        speed = np.concatenate([turned_deg, shifted_deg]) / step_s
        self._speed = self._speed + _share(_SPEED_HZ, step_s) * (speed - self._speed)
        fastest = max(float(np.linalg.norm(self._speed[:3])), float(np.linalg.norm(self._speed[3:])))
        share = _share(self._slowest_hz + self._quickening * fastest, step_s)
        self._turn = Rotation.from_rotvec(share * (turn * self._turn.inv()).as_rotvec()) * self._turn
        self._place = self._place + share * (place - self._place)
        self._raw_turn, self._raw_place = turn, place

    def _pose(self) -> Pose:
        assert self._turn is not None
        pose = np.eye(4)
        pose[:3, :3] = self._turn.as_matrix()
        pose[:3, 3] = self._place - self._turn.apply(self._pivot_m)
        return pose


def _share(cutoff_hz: float, step_s: float) -> float:
    """Return the share of the new value in an exponential average with that cutoff (eq. 4 and 5 of the paper)."""
    rate = 2.0 * np.pi * cutoff_hz * step_s
    return float(rate / (rate + 1.0))


class SmoothedTracker:
    """Tracker over another. smoothing: may be switched at any time, from another thread."""

    def __init__(self, tracker: Tracker, smoothing: bool = False, pivot_m: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> None:
        self.tracker, self.smoothing, self.name = tracker, smoothing, tracker.name
        self._filter = OneEuroPose(pivot_m=pivot_m)

    def track(self, frame: CameraFrame, intrinsics: Camera) -> TrackedPose | None:
        tracked = self.tracker.track(frame, intrinsics)
        if tracked is None or not tracked.is_certain or not self.smoothing:
            self._filter.reset()
            return tracked
        return replace(tracked, camera_from_world=self._filter(tracked.camera_from_world, tracked.captured_s))

    def close(self) -> None:
        self.tracker.close()
