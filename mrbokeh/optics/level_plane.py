"""A level plane, such as the ground or a table, as a camera sees it. Up is -y."""

import numpy as np
from jaxtyping import Float32

from mrbokeh.optics.camera import Camera


def level_plane_dioptres(camera: Camera, y_m: float = 0.0) -> Float32[np.ndarray, "height width"]:
    """(H, W): 1 / depth along the optical axis of the plane y = y_m of the world at every pixel; 0 where it is not seen.

    On a plane it is linear in the pixel's position, so that it is finite up to the horizon and beyond. The pose turns as it likes.
    """
    turn, eye_y_m = camera.world_from_camera[1, :3], float(camera.world_from_camera[1, 3])
    below_m = y_m - eye_y_m
    if below_m == 0.0:
        return np.zeros((camera.height_px, camera.width_px), np.float32)
    # How far down a ray goes that is 1 long along the axis: of its column, and of its row.
    x = (np.arange(camera.width_px) + 0.5 - camera.principal_px[0]) / camera.focal_px[0] * turn[0]
    y = (np.arange(camera.height_px) + 0.5 - camera.principal_px[1]) / camera.focal_px[1] * turn[1] + turn[2]
    dioptres = (y / below_m).astype(np.float32)[:, None] + (x / below_m).astype(np.float32)
    return np.maximum(dioptres, 0.0, out=dioptres)
