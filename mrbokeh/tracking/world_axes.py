"""Axes of other programs: cameras that look along -z with y up (OpenGL, Nuke, nerfstudio), and worlds with another axis up.

Ours look along +z with y down. Nothing here mirrors: every change of axes is a rotation.

From the world of a tracker to the upright world in which scenes stand: x right, y down, z forward, the table at y = 0.

The axes of tracking systems whose stage is Z up with cameras that look along +Y (OpenTrackIO, FreeD), and ours.
"""

from dataclasses import replace

import numpy as np
from jaxtyping import Float, Float64
from scipy.spatial.transform import Rotation

from mrbokeh.optics.camera import Camera

Pose = Float64[np.ndarray, "4 4"]

_FLIPPED = np.diag([1.0, -1.0, -1.0, 1.0])


def rigid(rotation: Float64[np.ndarray, "3 3"], place: Float64[np.ndarray, "3"]) -> Pose:
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = rotation, place
    return pose


def inverted(pose: Pose) -> Pose:
    """Of a rigid transform."""
    return rigid(pose[:3, :3].T, -pose[:3, :3].T @ pose[:3, 3])


def from_opengl(world_from_opengl_camera: Pose) -> Pose:
    """Our camera_from_world."""
    return _FLIPPED @ inverted(world_from_opengl_camera)


def to_opengl(camera_from_world: Pose) -> Pose:
    """The inverse of `from_opengl`."""
    return inverted(camera_from_world) @ _FLIPPED


UPRIGHT_FROM_WORLD = {
    "-z": np.array([[1.0, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0], [0, 0, 0, 1]]),
    "+z": np.array([[1.0, 0, 0, 0], [0, 0, -1, 0], [0, 1, 0, 0], [0, 0, 0, 1]]),
    "-y": np.eye(4),
    "+y": np.diag([1.0, -1.0, -1.0, 1.0]),
}
"""By what points up. "-z" is a board as OpenCV has it (x right, y down along the board, z into the table); OpenTrackIO and FreeD are
turned into one where they are read. "+z" is a floor with z up, "-y" mrbokeh and most COLMAP maps, "+y" ARKit and Blender's glTF.
None of them mirrors."""


def upright_camera(camera: Camera, up: str) -> Camera:
    """The same camera, with the pose that it has in the upright world."""
    return replace(camera, camera_from_world=camera.camera_from_world @ UPRIGHT_FROM_WORLD[up].T)


def turned(vector: tuple[float, float, float], up: str) -> tuple[float, float, float]:
    """A vector or point of the tracker's world in the upright one; both have one origin."""
    x, y, z = (UPRIGHT_FROM_WORLD[up][:3, :3] @ np.asarray(vector, np.float64)).tolist()
    return x, y, z


def turned_back(vector: tuple[float, float, float], up: str) -> tuple[float, float, float]:
    """The inverse of `turned`."""
    x, y, z = (UPRIGHT_FROM_WORLD[up][:3, :3].T @ np.asarray(vector, np.float64)).tolist()
    return x, y, z


def rays(camera: Camera, xy_px: Float[np.ndarray, "points 2"]) -> Float[np.ndarray, "points 3"]:
    """Directions in the camera's world through points of the picture, 1 long along the optical axis."""
    return camera.unproject(xy_px, np.ones(len(xy_px))) - camera.world_from_camera[:3, 3]


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
