"""PhoneRig: a phone fixed to the camera (on its hot shoe), and where it sits there, calibrated once.

Where both see the same board at the same time, camera_from_world = camera_from_phone @ phone_from_world for every pair of poses. It is
refined by least squares on SE(3).

phone_rig.json: {"format": "mrbokeh-phone-rig", "version": 1, "camera_from_phone": 4x4, "residual_deg", "residual_mm", "pairs"}
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float, Float64
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from mrbokeh.optics.lens import MM_PER_M
from mrbokeh.system.atomic_files import read_json, write_json
from mrbokeh.system.errors import InputError
from mrbokeh.tracking.world_axes import inverted, rigid
from viewfinder.frames import Pose


def rigid_of(parameters: Float[np.ndarray, "6"]) -> Pose:
    """Build a motion from an axis-angle vector (radians) followed by a translation."""
    return rigid(Rotation.from_rotvec(parameters[:3]).as_matrix(), parameters[3:])


def parameters_of(motion: Pose) -> Float[np.ndarray, "6"]:
    """Return the parameters of a motion, the inverse of `rigid_of`."""
    return np.concatenate([Rotation.from_matrix(motion[:3, :3]).as_rotvec(), motion[:3, 3]])


def angle_deg(motion: Pose) -> float:
    """Return how far a motion turns."""
    return float(np.degrees(Rotation.from_matrix(motion[:3, :3]).magnitude()))


FORMAT = "mrbokeh-phone-rig"
VERSION = 1
FEWEST_PAIRS = 5

_LARGEST_RESIDUAL_DEG = 2.0
_LARGEST_RESIDUAL_MM = 20.0
_ROBUST_M = 0.003
_RIGID = 1e-4


@dataclass(frozen=True)
class PosePair:
    """Poses of the phone and of the camera at one moment, each over its world."""

    phone_from_world: Pose
    camera_from_world: Pose


@dataclass(frozen=True)
class PhoneRig:
    """Phone fixed to the camera. residual_deg, residual_mm: RMS by which the pairs of the calibration disagree with it."""

    camera_from_phone: Pose
    residual_deg: float
    residual_mm: float
    pairs: int


def calibrate_rig(pairs: Sequence[PosePair]) -> PhoneRig:
    """Solve where the phone sits from poses of both over one board; InputError with too few pairs, or if they contradict one another."""
    if len(pairs) < FEWEST_PAIRS:
        raise InputError(
            f"the calibration of the phone needs {FEWEST_PAIRS} pairs of poses or more, got {len(pairs)}: show both the board for longer"
        )
    each = [pair.camera_from_world @ inverted(pair.phone_from_world) for pair in pairs]
    start = rigid(Rotation.from_matrix([one[:3, :3] for one in each]).mean().as_matrix(), np.median([one[:3, 3] for one in each], axis=0))
    lever_m = float(np.median([np.linalg.norm(pair.camera_from_world[:3, 3]) for pair in pairs]))

    def off(parameters: Float[np.ndarray, "6"]) -> list[Pose]:
        rig = rigid_of(parameters)
        return [pair.camera_from_world @ inverted(rig @ pair.phone_from_world) for pair in pairs]

    def residuals(parameters: Float[np.ndarray, "6"]) -> Float64[np.ndarray, " residuals"]:
        """Return residuals in metres: turns count by what they move at the distance of the board."""
        return (np.array([parameters_of(each) for each in off(parameters)]) * ([lever_m] * 3 + [1.0] * 3)).ravel()

    found = least_squares(residuals, parameters_of(start), loss="soft_l1", f_scale=_ROBUST_M, x_scale="jac")
    left = off(found.x)
    residual_deg = float(np.sqrt(np.mean([angle_deg(each) ** 2 for each in left])))
    residual_mm = float(np.sqrt(np.mean([np.sum(each[:3, 3] ** 2) for each in left]))) * MM_PER_M
    if residual_deg > _LARGEST_RESIDUAL_DEG or residual_mm > _LARGEST_RESIDUAL_MM:
        raise InputError(
            f"phone and camera disagree by {residual_deg:.1f} degrees and {residual_mm:.0f} mm over the {len(pairs)} pairs: "
            f"fix the phone firmly, hold still for each pair and calibrate again"
        )
    return PhoneRig(rigid_of(found.x), residual_deg, residual_mm, len(pairs))


def write_phone_rig(path: Path | str, rig: PhoneRig) -> None:
    document = {"format": FORMAT, "version": VERSION, "camera_from_phone": rig.camera_from_phone.tolist()}
    write_json(path, document | {"residual_deg": rig.residual_deg, "residual_mm": rig.residual_mm, "pairs": rig.pairs})


def read_phone_rig(path: Path | str) -> PhoneRig:
    """Read the file of a rig; InputError where it is none."""
    document = read_json(path, "a phone rig (calibrate the phone on the camera)")
    try:
        if (document["format"], document["version"]) != (FORMAT, VERSION):
            raise ValueError(f"format {document['format']!r}, version {document['version']!r}")
        pose = np.asarray(document["camera_from_phone"], np.float64).reshape(4, 4)
        off = np.abs(pose[:3, :3] @ pose[:3, :3].T - np.eye(3)).max()
        if not (off < _RIGID and np.linalg.det(pose[:3, :3]) > 0 and np.isfinite(pose).all() and (pose[3] == (0, 0, 0, 1)).all()):
            raise ValueError("camera_from_phone is not a rigid motion")
        return PhoneRig(pose, float(document["residual_deg"]), float(document["residual_mm"]), int(document["pairs"]))
    except (KeyError, TypeError, ValueError) as error:
        raise InputError(f"{path} is not a phone rig of format {FORMAT!r} version {VERSION} ({error}): calibrate again") from None
