"""Messages of a browser camera over its data channel: one JSON object per message, such as {"focusDistance": 0.8}.

* focusDistance: metres from the camera, "infinity", or null where it is not known (MediaTrackSettings.focusDistance).
* pose: 16 numbers, WebXR's XRRigidTransform.matrix of the viewer (column after column; y up, the camera looks along -z).
* orientation: [x, y, z, w], AbsoluteOrientationSensor.quaternion with referenceFrame "screen" (from the screen to east, north, up).

What a message does not name stays as it was. Worlds become ours: x right, y down; of an orientation alone, z is north.
"""

import json
import math
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from mrbokeh.system.errors import InputError
from viewfinder.frames import UNKNOWN_LENS, LensState, Pose

LONGEST_MESSAGE = 4096
_KNOWN = ("focusDistance", "pose", "orientation")
_FLIP = np.diag([1.0, -1.0, -1.0, 1.0])
_OURS_FROM_EAST_NORTH_UP = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])
_ROTATION_TOLERANCE = 1e-2


@dataclass(frozen=True)
class CameraKnowledge:
    """Knowledge of a browser camera. camera_from_world: (4, 4), metres, or None."""

    lens: LensState = UNKNOWN_LENS
    camera_from_world: Pose | None = None

    def told(self, text: str) -> "CameraKnowledge":
        """Return the knowledge with what a message tells. Raises InputError with one sentence for what makes no sense."""
        message = _object(text)
        known = self
        if "focusDistance" in message:
            known = replace(known, lens=replace(known.lens, focus_distance_m=_distance_m(message["focusDistance"])))
        if "orientation" in message:
            known = replace(known, camera_from_world=_from_orientation(message["orientation"]))
        if "pose" in message:
            known = replace(known, camera_from_world=_from_pose(message["pose"]))
        return known


def _object(text: str) -> dict[str, Any]:
    if len(text) > LONGEST_MESSAGE:
        raise InputError(f"expected a message of at most {LONGEST_MESSAGE} characters, got {len(text)}")
    try:
        message = json.loads(text)
    except (ValueError, RecursionError):
        raise InputError("expected a message in JSON") from None
    if not isinstance(message, dict) or not message.keys() & set(_KNOWN):
        raise InputError(f"expected a JSON object with one of {', '.join(_KNOWN)}")
    return message


def _distance_m(value: Any) -> float | None:
    if value is None:
        return None
    if value == "infinity":
        return math.inf
    if isinstance(value, bool) or not isinstance(value, int | float) or not 0 < value < math.inf:
        raise InputError('focusDistance: expected metres above 0, "infinity" or null')
    return float(value)


def _from_pose(value: Any) -> Pose | None:
    """Convert XRRigidTransform.matrix, which is world from viewer; both have y up and z backward."""
    if value is None:
        return None
    matrix = _numbers(value, 16, "pose").reshape(4, 4).T
    rotation = matrix[:3, :3]
    if not np.allclose(rotation @ rotation.T, np.eye(3), atol=_ROTATION_TOLERANCE) or np.linalg.det(rotation) < 0:
        raise InputError("pose: expected a rotation and a translation, column after column")
    if not np.allclose(matrix[3], (0, 0, 0, 1), atol=1e-6):
        raise InputError("pose: expected 0, 0, 0, 1 as the last row of the matrix")
    return _FLIP @ np.linalg.inv(matrix) @ _FLIP


def _from_orientation(value: Any) -> Pose | None:
    """Convert an orientation: the screen has x right, y up, z towards its user; the camera looks the other way."""
    if value is None:
        return None
    x, y, z, w = quaternion = _numbers(value, 4, "orientation")
    length = float(np.linalg.norm(quaternion))
    if abs(length - 1) > _ROTATION_TOLERANCE:
        raise InputError("orientation: expected a quaternion of length 1, [x, y, z, w]")
    x, y, z, w = quaternion / length
    earth_from_screen = np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ]
    )
    pose = np.eye(4)
    pose[:3, :3] = (_OURS_FROM_EAST_NORTH_UP @ earth_from_screen @ _FLIP[:3, :3]).T
    return pose


def _numbers(value: Any, count: int, name: str) -> np.ndarray:
    fits = isinstance(value, list) and len(value) == count
    if not fits or not all(isinstance(each, int | float) and not isinstance(each, bool) and abs(each) < 1e6 for each in value):
        raise InputError(f"{name}: expected {count} numbers")
    return np.array(value, np.float64)
