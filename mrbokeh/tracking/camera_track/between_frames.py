"""What lies between two frames of a track.

Rotations go along the shortest arc (Shoemake 1985), places of the entrance pupil along a line: the last column of
camera_from_world turns with the camera, and a turning camera on a tripod would leave it. Focus goes linearly in dioptres, as rings
of lenses and the blur do, the aperture in stops.
"""

import numpy as np
from jaxtyping import Float64
from scipy.spatial.transform import Rotation

from mrbokeh.optics.camera import Camera
from mrbokeh.tracking.camera_track.tracked_frame import Distortion, TrackedFrame

Pose = Float64[np.ndarray, "4 4"]


def between(one: TrackedFrame, other: TrackedFrame, share: float) -> TrackedFrame:
    """share 0 is one, 1 is the other; what only one of them knows is not known in between."""
    return TrackedFrame(
        camera_between(one.camera, other.camera, share),
        focus_between_m(one.focus_distance_m, other.focus_distance_m, share),
        stop_between(one.f_number, other.f_number, share),
        _linear(one.time_s, other.time_s, share),
        _distortion(one.distortion, other.distortion, share),
    )


def camera_between(one: Camera, other: Camera, share: float) -> Camera:
    pose = pose_between(one.camera_from_world, other.camera_from_world, share)
    focal, principal = (
        tuple((1.0 - share) * x + share * y for x, y in zip(*pair, strict=True))
        for pair in ((one.focal_px, other.focal_px), (one.principal_px, other.principal_px))
    )
    return Camera(one.width_px, one.height_px, (focal[0], focal[1]), (principal[0], principal[1]), pose)


def pose_between(one: Pose, other: Pose, share: float) -> Pose:
    """Of two camera_from_world."""
    a, b = np.linalg.inv(one), np.linalg.inv(other)
    turn = Rotation.from_matrix(a[:3, :3].T @ b[:3, :3]).as_rotvec()
    pose = np.eye(4)
    pose[:3, :3] = (a[:3, :3] @ Rotation.from_rotvec(share * turn).as_matrix()).T
    pose[:3, 3] = -pose[:3, :3] @ ((1.0 - share) * a[:3, 3] + share * b[:3, 3])
    return pose


def focus_between_m(one_m: float | None, other_m: float | None, share: float) -> float | None:
    if one_m is None or other_m is None:
        return None
    dioptres = (1.0 - share) / one_m + share / other_m
    return 1.0 / dioptres if dioptres > 0.0 else float("inf")


def stop_between(one: float | None, other: float | None, share: float) -> float | None:
    if one is None or other is None:
        return None
    return float(one ** (1.0 - share) * other**share)


def _linear(one: float | None, other: float | None, share: float) -> float | None:
    return None if one is None or other is None else (1.0 - share) * one + share * other


def _distortion(one: Distortion | None, other: Distortion | None, share: float) -> Distortion | None:
    """A coefficient that is not told is 0."""
    if one is None and other is None:
        return None
    a, b = one or {}, other or {}
    return {name: (1.0 - share) * a.get(name, 0.0) + share * b.get(name, 0.0) for name in {**a, **b}}
