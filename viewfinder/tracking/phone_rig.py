"""PhoneRig: a phone fixed to the camera (on its hot shoe), and where it sits there, calibrated once.

Where both see the same board at the same time, camera_from_world = camera_from_phone @ phone_from_world for every pair of poses.
Where each has a world of its own (the phone a map, the camera a board), relative motions give A X = X B, X = camera_from_phone:
the rotation aligns the axes of the turns, the rest is linear (Park and Martin 1994). Both are refined by least squares on SE(3).

phone_rig.json: {"format": "mrbokeh-phone-rig", "version": 1, "camera_from_phone": 4x4, "residual_deg", "residual_mm", "pairs"}

Rigid motions as (4, 4) matrices: made from an axis-angle vector, taken apart, and how far they turn.
"""

from collections.abc import Callable, Sequence
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
    """From an axis-angle vector (radians) followed by a translation."""
    return rigid(Rotation.from_rotvec(parameters[:3]).as_matrix(), parameters[3:])


def parameters_of(motion: Pose) -> Float[np.ndarray, "6"]:
    """The inverse of `rigid_of`."""
    return np.concatenate([Rotation.from_matrix(motion[:3, :3]).as_rotvec(), motion[:3, 3]])


def angle_deg(motion: Pose) -> float:
    """How far a motion turns."""
    return float(np.degrees(Rotation.from_matrix(motion[:3, :3]).magnitude()))


FORMAT = "mrbokeh-phone-rig"
VERSION = 1
FEWEST_PAIRS = 5

_LARGEST_RESIDUAL_DEG = 2.0
_LARGEST_RESIDUAL_MM = 20.0
_LEAST_TURN_DEG = 10.0
_ROBUST_M = 0.003
_RIGID = 1e-4


@dataclass(frozen=True)
class PosePair:
    """Poses of the phone and of the camera at one moment, each over its world."""

    phone_from_world: Pose
    camera_from_world: Pose


@dataclass(frozen=True)
class PhoneRig:
    """residual_deg, residual_mm: RMS by which the pairs of the calibration disagree with it."""

    camera_from_phone: Pose
    residual_deg: float
    residual_mm: float
    pairs: int


def calibrate_in_one_world(pairs: Sequence[PosePair]) -> PhoneRig:
    """Both see the same board. Raises InputError with too few pairs, or where they contradict one another."""
    _require_pairs(pairs)
    each = [pair.camera_from_world @ inverted(pair.phone_from_world) for pair in pairs]
    start = rigid(Rotation.from_matrix([one[:3, :3] for one in each]).mean().as_matrix(), np.median([one[:3, 3] for one in each], axis=0))
    return _refined(pairs, parameters_of(start), lambda parameters: (rigid_of(parameters), np.eye(4)))


def calibrate_across_worlds(pairs: Sequence[PosePair]) -> PhoneRig:
    """Each has its own world, in metres. The camera must have been turned about two axes at least."""
    _require_pairs(pairs)
    motions = [
        (b.camera_from_world @ inverted(a.camera_from_world), b.phone_from_world @ inverted(a.phone_from_world))
        for index, a in enumerate(pairs)
        for b in pairs[index + 1 :]
    ]
    of_camera, of_phone = (np.array([parameters_of(pair[which])[:3] for pair in motions]) for which in (0, 1))
    if np.degrees(np.linalg.svd(of_phone, compute_uv=False)[1] / np.sqrt(len(motions))) < _LEAST_TURN_DEG:
        raise InputError(
            f"the camera was turned about one axis only: turn it by {_LEAST_TURN_DEG:g} degrees and more up and down, to the sides and over"
        )
    turn = Rotation.align_vectors(of_camera, of_phone)[0].as_matrix()
    rows = np.concatenate([a[:3, :3] - np.eye(3) for a, _ in motions])
    shift = np.linalg.lstsq(rows, np.concatenate([turn @ b[:3, 3] - a[:3, 3] for a, b in motions]), rcond=None)[0]
    rig = rigid(turn, shift)
    worlds = inverted(pairs[0].phone_from_world) @ inverted(rig) @ pairs[0].camera_from_world
    start = np.concatenate([parameters_of(rig), parameters_of(worlds)])
    return _refined(pairs, start, lambda parameters: (rigid_of(parameters[:6]), rigid_of(parameters[6:])))


def write_phone_rig(path: Path | str, rig: PhoneRig) -> None:
    document = {"format": FORMAT, "version": VERSION, "camera_from_phone": rig.camera_from_phone.tolist()}
    write_json(path, document | {"residual_deg": rig.residual_deg, "residual_mm": rig.residual_mm, "pairs": rig.pairs})


def read_phone_rig(path: Path | str) -> PhoneRig:
    """Raises InputError where the file is not that of a rig."""
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


def _require_pairs(pairs: Sequence[PosePair]) -> None:
    if len(pairs) < FEWEST_PAIRS:
        raise InputError(
            f"the calibration of the phone needs {FEWEST_PAIRS} pairs of poses or more, got {len(pairs)}: show both the board longer"
        )


Motions = Callable[[Float64[np.ndarray, " parameters"]], tuple[Pose, Pose]]
"""Parameters to (camera_from_phone, the phone's world from the camera's world)."""


def _refined(pairs: Sequence[PosePair], start: Float64[np.ndarray, " parameters"], motions: Motions) -> PhoneRig:
    lever_m = float(np.median([np.linalg.norm(pair.camera_from_world[:3, 3]) for pair in pairs]))

    def off(parameters: Float64[np.ndarray, " parameters"]) -> list[Pose]:
        rig, worlds = motions(parameters)
        return [pair.camera_from_world @ inverted(rig @ pair.phone_from_world @ worlds) for pair in pairs]

    def residuals(parameters: Float64[np.ndarray, " parameters"]) -> Float64[np.ndarray, " residuals"]:
        """Metres: turns count by what they move at the distance of the board."""
        return (np.array([parameters_of(each) for each in off(parameters)]) * ([lever_m] * 3 + [1.0] * 3)).ravel()

    found = least_squares(residuals, start, loss="soft_l1", f_scale=_ROBUST_M, x_scale="jac")
    left = off(found.x)
    residual_deg = float(np.sqrt(np.mean([angle_deg(each) ** 2 for each in left])))
    residual_mm = float(np.sqrt(np.mean([np.sum(each[:3, 3] ** 2) for each in left]))) * MM_PER_M
    if residual_deg > _LARGEST_RESIDUAL_DEG or residual_mm > _LARGEST_RESIDUAL_MM:
        raise InputError(
            f"phone and camera disagree by {residual_deg:.1f} degrees and {residual_mm:.0f} mm over the {len(pairs)} pairs: "
            f"fix the phone firmly, hold still for each pair and calibrate again"
        )
    return PhoneRig(motions(found.x)[0], residual_deg, residual_mm, len(pairs))
