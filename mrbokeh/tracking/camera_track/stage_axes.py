"""The axes of tracking systems whose stage is Z up with cameras that look along +Y (OpenTrackIO, FreeD), and ours."""

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

CAMERA_FROM_STAGE_CAMERA = np.array([[1.0, 0.0, 0.0, 0.0], [0.0, 0.0, -1.0, 0.0], [0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0]])
"""From a camera that looks along +Y with Z up to ours, which looks along +z with y down."""

_STEEP = 1e-9


def stage_rotation(pan_deg: float, tilt_deg: float, roll_deg: float) -> Float[np.ndarray, "3 3"]:
    """Intrinsic right-handed rotations about Z, X, Y, in this order."""
    return np.asarray(Rotation.from_euler("ZXY", [pan_deg, tilt_deg, roll_deg], degrees=True).as_matrix())


def pan_tilt_roll_deg(rotation: Float[np.ndarray, "3 3"]) -> tuple[float, float, float]:
    """The inverse of `stage_rotation`; a camera that looks straight up or down has no roll, its pan says all."""
    across = float(np.hypot(rotation[0, 1], rotation[1, 1]))
    tilt = np.arctan2(rotation[2, 1], across)
    if across < _STEEP:
        pan, roll = np.arctan2(rotation[1, 0], rotation[0, 0]), 0.0
    else:
        pan, roll = np.arctan2(-rotation[0, 1], rotation[1, 1]), np.arctan2(-rotation[2, 0], rotation[2, 2])
    return float(np.degrees(pan)), float(np.degrees(tilt)), float(np.degrees(roll))
