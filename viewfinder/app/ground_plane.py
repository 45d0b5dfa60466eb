"""Where a point of the picture lies on the ground: the homography that the page drags objects with."""

import numpy as np
from jaxtyping import Float

from mrbokeh.optics.camera import Camera
from mrbokeh.tracking.world_axes import upright_camera

_LEAST_DETERMINANT = 1e-12


def ground_from_picture(camera: Camera, up: str) -> Float[np.ndarray, "3 3"] | None:
    """(x, y, 1), right and down from 0 to 1 in the picture, to (x, z) in metres on the table, times their third component.

    camera: with its pose in the tracker's world; up: which of its directions is up. A ground point (x, 0, z) is seen at
    K [r_1 r_3 t] (x, z, 1) for a camera with the pose [r_1 r_2 r_3 | t] (Hartley and Zisserman 2004, 8.1.1). None where the eye is
    in the table.
    """
    pose = upright_camera(camera, up).camera_from_world
    (fx, fy), (cx, cy) = camera.focal_px, camera.principal_px
    intrinsics = np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])
    share_from_px = np.diag([1.0 / camera.width_px, 1.0 / camera.height_px, 1.0])
    picture_from_ground = share_from_px @ intrinsics @ pose[:3, [0, 2, 3]]
    if abs(np.linalg.det(picture_from_ground)) < _LEAST_DETERMINANT:
        return None
    return np.asarray(np.linalg.inv(picture_from_ground))
