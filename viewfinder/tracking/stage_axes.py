"""The axes of tracking systems whose stage is Z up with cameras that look along +Y, and ours."""

import numpy as np
from jaxtyping import Float

STAGE_FROM_BOARD = np.diag([1.0, -1.0, -1.0, 1.0])
"""Our world (x right, y down the board, z into it) lies on the stage's ground: y along -Y, z along -Z."""

CAMERA_FROM_STAGE_CAMERA = np.array([[1.0, 0.0, 0.0, 0.0], [0.0, 0.0, -1.0, 0.0], [0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0]])
"""From a camera that looks along +Y with Z up to ours, which looks along +z with y down."""

_STEEP = 1e-9


def pan_tilt_roll_deg(rotation: Float[np.ndarray, "3 3"]) -> tuple[float, float, float]:
    """Intrinsic right-handed rotations about Z, X, Y; a camera that looks straight up or down has no roll, its pan says all."""
    across = float(np.hypot(rotation[0, 1], rotation[1, 1]))
    tilt = np.arctan2(rotation[2, 1], across)
    if across < _STEEP:
        pan, roll = np.arctan2(rotation[1, 0], rotation[0, 0]), 0.0
    else:
        pan, roll = np.arctan2(-rotation[0, 1], rotation[1, 1]), np.arctan2(-rotation[2, 0], rotation[2, 2])
    return float(np.degrees(pan)), float(np.degrees(tilt)), float(np.degrees(roll))
