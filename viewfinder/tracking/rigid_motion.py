"""Rigid motions as (4, 4) matrices: made from an axis-angle vector, taken apart, inverted, and what lies between two of them."""

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from viewfinder.frames import Pose


def rigid(rotation: Float[np.ndarray, "3 3"], translation: Float[np.ndarray, "3"]) -> Pose:
    motion = np.eye(4)
    motion[:3, :3], motion[:3, 3] = rotation, translation
    return motion


def rigid_of(parameters: Float[np.ndarray, "6"]) -> Pose:
    """From an axis-angle vector (radians) followed by a translation."""
    return rigid(Rotation.from_rotvec(parameters[:3]).as_matrix(), parameters[3:])


def parameters_of(motion: Pose) -> Float[np.ndarray, "6"]:
    """The inverse of `rigid_of`."""
    return np.concatenate([Rotation.from_matrix(motion[:3, :3]).as_rotvec(), motion[:3, 3]])


def inverted(motion: Pose) -> Pose:
    return rigid(motion[:3, :3].T, -motion[:3, :3].T @ motion[:3, 3])


def between(camera_from_world_a: Pose, camera_from_world_b: Pose, share: float) -> Pose:
    """The camera between two poses: its place goes along the line, its rotation about one axis (Shoemake 1985); share 0 is a, 1 is b.

    Places are interpolated, not the last columns: these turn with the camera, and a turning camera on a tripod would leave it.
    """
    a, b = inverted(camera_from_world_a), inverted(camera_from_world_b)
    turn = Rotation.from_matrix(a[:3, :3].T @ b[:3, :3]).as_rotvec()
    rotation = a[:3, :3] @ Rotation.from_rotvec(share * turn).as_matrix()
    return inverted(rigid(rotation, (1.0 - share) * a[:3, 3] + share * b[:3, 3]))


def angle_deg(motion: Pose) -> float:
    """How far a motion turns."""
    return float(np.degrees(Rotation.from_matrix(motion[:3, :3]).magnitude()))
