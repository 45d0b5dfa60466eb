"""Axes of other programs: cameras that look along -z with y up (OpenGL, Nuke, nerfstudio), and worlds with another axis up.

Ours look along +z with y down. Nothing here mirrors: every change of axes is a rotation.
"""

from dataclasses import replace

import numpy as np
from jaxtyping import Float64

from mrbokeh.tracking.camera_track.track import CameraTrack
from mrbokeh.tracking.upright import UPRIGHT_FROM_WORLD

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


def with_up(track: CameraTrack, up: str) -> CameraTrack:
    """The same cameras in a world turned about its origin, such that `up` is up."""
    if up == track.up:
        return track
    old_from_new = UPRIGHT_FROM_WORLD[track.up].T @ UPRIGHT_FROM_WORLD[up]
    frames = {
        number: replace(each, camera=replace(each.camera, camera_from_world=each.camera.camera_from_world @ old_from_new))
        for number, each in track.frames.items()
    }
    return replace(track, frames=frames, up=up)
