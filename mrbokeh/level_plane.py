"""A level plane, such as the ground or a table, as a camera sees it. Up is -y."""

import numpy as np
from jaxtyping import Float32

from mrbokeh.camera import Camera


def level_plane_dioptres(camera: Camera, y_m: float = 0.0) -> Float32[np.ndarray, "height width"]:
    """(H, W): 1 / depth along the optical axis of the plane y = y_m of the world at every pixel; 0 where it is not seen.

    On a plane it is linear in the pixel's position, so that it is finite up to the horizon and beyond. The pose turns as it likes.
    """
    eye_m = camera.world_from_camera[:3, 3]
    ahead = camera.unproject(camera.pixel_centres_px(), np.ones((camera.height_px, camera.width_px))) - eye_m
    below_m = y_m - eye_m[1]
    if below_m == 0.0:
        return np.zeros(ahead.shape[:2], np.float32)
    return np.maximum(ahead[..., 1] / below_m, 0.0).astype(np.float32)
