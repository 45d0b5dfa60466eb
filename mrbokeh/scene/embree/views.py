"""The camera of a ray caster: which pixels a scene can be seen in, and the rays through points of the picture."""

import numpy as np
from jaxtyping import Float, Float64

from mrbokeh.optics.camera import Camera
from mrbokeh.scene.embree.packed_triangles import PreparedScene

ROWS_AT_ONCE = 512
_ROOM_PX = 2


def window(ready: PreparedScene, camera: Camera) -> tuple[slice, slice]:
    """Rows and columns outside which nothing of the scene is; the whole picture where the camera is within or before its box."""
    signs = np.array(np.meshgrid((-1.0, 1.0), (-1.0, 1.0), (-1.0, 1.0))).reshape(3, -1).T
    low, high, size = np.zeros(2), np.zeros(2), np.array([camera.width_px, camera.height_px])
    corners_m = ready.centre_m + signs * ready.half_size_m
    ahead_m = corners_m @ camera.camera_from_world[2, :3] + camera.camera_from_world[2, 3]
    if ahead_m.max() <= 0:
        return slice(0, 0), slice(0, 0)
    if ahead_m.min() <= 1e-3 * ready.reach_m:
        return slice(0, camera.height_px), slice(0, camera.width_px)
    xy_px, _ = camera.project(corners_m)
    low, high = (np.clip(each, -_ROOM_PX, size + _ROOM_PX) for each in (np.floor(xy_px.min(0)), np.ceil(xy_px.max(0))))
    (left, top), (right, bottom) = (np.clip(each, 0, size).astype(int).tolist() for each in (low - _ROOM_PX, high + _ROOM_PX))
    return slice(top, bottom), slice(left, right)


def cut(camera: Camera, rows: slice, columns: slice) -> Camera:
    """The camera that sees only these pixels."""
    principal = (camera.principal_px[0] - columns.start, camera.principal_px[1] - rows.start)
    return Camera(columns.stop - columns.start, rows.stop - rows.start, camera.focal_px, principal, camera.camera_from_world)


def row_centres_px(camera: Camera, first: int) -> Float64[np.ndarray, "points 2"]:
    """Centres of the pixels of some rows: those of a whole large picture, as rays, would take gigabytes."""
    rows = np.arange(first, min(first + ROWS_AT_ONCE, camera.height_px)) + 0.5
    x, y = np.meshgrid(np.arange(camera.width_px) + 0.5, rows)
    return np.stack([x, y], axis=-1).reshape(-1, 2)


def ray_directions(camera: Camera, xy_px: Float[np.ndarray, "points 2"]) -> Float64[np.ndarray, "points 3"]:
    """Rays through points of the picture in world space, 1 long along the optical axis."""
    right, down, forward = camera.world_from_camera[:3, :3].T
    x, y = ((xy_px - np.asarray(camera.principal_px)) / np.asarray(camera.focal_px)).T
    return np.stack([x * right[axis] + y * down[axis] + forward[axis] for axis in range(3)], axis=-1)
