"""Rigid motions as (4, 4) matrices: made from an axis-angle vector, taken apart, and how far they turn."""

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from mrbokeh.tracking.world_axes import rigid
from viewfinder.frames import Pose


def rigid_of(parameters: Float[np.ndarray, "6"]) -> Pose:
    """From an axis-angle vector (radians) followed by a translation."""
    return rigid(Rotation.from_rotvec(parameters[:3]).as_matrix(), parameters[3:])


def parameters_of(motion: Pose) -> Float[np.ndarray, "6"]:
    """The inverse of `rigid_of`."""
    return np.concatenate([Rotation.from_matrix(motion[:3, :3]).as_rotvec(), motion[:3, 3]])


def angle_deg(motion: Pose) -> float:
    """How far a motion turns."""
    return float(np.degrees(Rotation.from_matrix(motion[:3, :3]).magnitude()))
