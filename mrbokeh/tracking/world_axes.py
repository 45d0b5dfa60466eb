"""Axes of worlds and cameras: the upright world in which scenes stand, and those of trackers and other programs.

Our cameras look along +z with y down, our upright world has x right, y down, z forward, the table at y = 0. OpenGL, Nuke and nerfstudio
have cameras that look along -z with y up; stages of OpenTrackIO and FreeD are Z up with cameras that look along +Y. Nothing here mirrors:
every change of axes is a rotation.
"""

from dataclasses import replace

import numpy as np
from jaxtyping import Float, Float64

from mrbokeh.optics.camera import Camera

Pose = Float64[np.ndarray, "4 4"]

_FLIPPED = np.diag([1.0, -1.0, -1.0, 1.0])


def rigid(rotation: Float64[np.ndarray, "3 3"], place: Float64[np.ndarray, "3"]) -> Pose:
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = rotation, place
    return pose


def inverted(pose: Pose) -> Pose:
    """Return the inverse of a rigid transform."""
    return rigid(pose[:3, :3].T, -pose[:3, :3].T @ pose[:3, 3])


def from_opengl(world_from_opengl_camera: Pose) -> Pose:
    """Return our camera_from_world."""
    return _FLIPPED @ inverted(world_from_opengl_camera)


def to_opengl(camera_from_world: Pose) -> Pose:
    """Return OpenGL's world_from_camera: the inverse of `from_opengl`."""
    return inverted(camera_from_world) @ _FLIPPED


UPRIGHT_FROM_WORLD = {
    "-z": np.array([[1.0, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0], [0, 0, 0, 1]]),
    "+z": np.array([[1.0, 0, 0, 0], [0, 0, -1, 0], [0, 1, 0, 0], [0, 0, 0, 1]]),
    "-y": np.eye(4),
    "+y": np.diag([1.0, -1.0, -1.0, 1.0]),
}
"""Rotations by the axis that points up.

"-z" is a board as OpenCV has it (x right, y down along the board, z into the table); OpenTrackIO and FreeD are
turned into one where they are read. "+z" is a floor with z up, "-y" mrbokeh and most COLMAP maps, "+y" ARKit and Blender's glTF.
None of them mirrors."""


def upright_camera(camera: Camera, up: str) -> Camera:
    """Return the same camera, with the pose that it has in the upright world."""
    return replace(camera, camera_from_world=camera.camera_from_world @ UPRIGHT_FROM_WORLD[up].T)


def turned(vector: tuple[float, float, float], up: str) -> tuple[float, float, float]:
    """Turn a vector or point of the tracker's world into the upright one; both have one origin."""
    x, y, z = (UPRIGHT_FROM_WORLD[up][:3, :3] @ np.asarray(vector, np.float64)).tolist()
    return x, y, z


def turned_back(vector: tuple[float, float, float], up: str) -> tuple[float, float, float]:
    """Turn a vector back: the inverse of `turned`."""
    x, y, z = (UPRIGHT_FROM_WORLD[up][:3, :3].T @ np.asarray(vector, np.float64)).tolist()
    return x, y, z


def rays(camera: Camera, xy_px: Float[np.ndarray, "points 2"]) -> Float[np.ndarray, "points 3"]:
    """Return directions in the camera's world through points of the picture, 1 long along the optical axis."""
    return camera.unproject(xy_px, np.ones(len(xy_px))) - camera.world_from_camera[:3, 3]


CAMERA_FROM_STAGE_CAMERA = np.array([[1.0, 0.0, 0.0, 0.0], [0.0, 0.0, -1.0, 0.0], [0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0]])
"""Rotation from a camera that looks along +Y with Z up to ours, which looks along +z with y down."""

_STEEP = 1e-9


def stage_rotation(pan_deg: float, tilt_deg: float, roll_deg: float) -> Float[np.ndarray, "3 3"]:
    """Return intrinsic right-handed rotations about Z, X, Y, in this order."""
    from scipy.spatial.transform import Rotation

    return np.asarray(Rotation.from_euler("ZXY", [pan_deg, tilt_deg, roll_deg], degrees=True).as_matrix())


def pan_tilt_roll_deg(rotation: Float[np.ndarray, "3 3"]) -> tuple[float, float, float]:
    """Return the angles of `stage_rotation`; a camera that looks straight up or down has no roll, its pan says all."""
    across = float(np.hypot(rotation[0, 1], rotation[1, 1]))
    tilt = np.arctan2(rotation[2, 1], across)
    if across < _STEEP:
        pan, roll = np.arctan2(rotation[1, 0], rotation[0, 0]), 0.0
    else:
        pan, roll = np.arctan2(-rotation[0, 1], rotation[1, 1]), np.arctan2(-rotation[2, 0], rotation[2, 2])
    return float(np.degrees(pan)), float(np.degrees(tilt)), float(np.degrees(roll))
