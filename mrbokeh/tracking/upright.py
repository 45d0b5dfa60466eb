"""From the world of a tracker to the upright world in which scenes stand: x right, y down, z forward, the table at y = 0."""

from dataclasses import replace

import numpy as np
from jaxtyping import Float

from mrbokeh.optics.camera import Camera

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
