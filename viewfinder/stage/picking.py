"""What lies under a point of the picture: which object, which place of the table, at which depth."""

import numpy as np
from jaxtyping import Float

from mrbokeh.optics.camera import Camera
from mrbokeh.scene import Scene
from mrbokeh.scene.staging.scene_description import Triple
from mrbokeh.system.errors import InputError
from mrbokeh.tracking.world_axes import rays, turned_back
from viewfinder.stage.occlusion import Occlusion
from viewfinder.stage.seen import Seen

_FARTHEST_M = 100.0
_PARALLEL = 1e-12


def object_at(seen: Seen, x_px: float, y_px: float) -> tuple[str, float] | None:
    """Name and depth (metres, along the optical axis) of the virtual object at a point of the newest picture; None where there is none."""
    eye_m, ray = _ray(seen.camera, x_px, y_px)
    parts = seen.staged.parts_at(seen.drawing.request.time_s)
    met = [(_nearest_m(scene, eye_m, ray), name) for name, scene in parts.items()]
    depth_m, name = min(met, default=(float("inf"), ""))
    real_m = _real_depth_m(seen.occlusion, seen.camera, x_px, y_px)
    return (name, depth_m) if depth_m < min(real_m, _FARTHEST_M) else None


def table_point_m(seen: Seen, x_px: float, y_px: float, height_m: float = 0.0) -> Triple | None:
    """Where the ray through a point of the picture meets the table, in the tracker's world; None where it does not within 100 m.

    height_m: of the plane above the table: dragging an object that floats moves it in the plane in which it is.
    """
    eye_m, ray = _ray(seen.camera, x_px, y_px)
    depth_m = _table_depth_m(eye_m, ray, height_m)
    if not depth_m < _FARTHEST_M:
        return None
    x, y, z = (eye_m + depth_m * ray).tolist()
    return turned_back((x, y, z), seen.staged.description.up)


def depth_at_m(seen: Seen, x_px: float, y_px: float) -> float:
    """What a tap there focuses on: the virtual object, else the depth that was measured, else the table. InputError for none of them."""
    picked = object_at(seen, x_px, y_px)
    if picked is not None:
        return picked[1]
    eye_m, ray = _ray(seen.camera, x_px, y_px)
    known_m = _real_depth_m(seen.occlusion, seen.camera, x_px, y_px), _table_depth_m(eye_m, ray)
    depth_m = next((each for each in known_m if each < _FARTHEST_M), None)
    if depth_m is None:
        raise InputError(f"cannot focus at ({x_px:g}, {y_px:g}): expected an object or the table there, found neither; tap on one of them")
    return depth_m


def _ray(camera: Camera, x_px: float, y_px: float) -> tuple[Float[np.ndarray, "3"], Float[np.ndarray, "3"]]:
    if not (0.0 <= x_px <= camera.width_px and 0.0 <= y_px <= camera.height_px):
        raise InputError(f"expected a point in the picture of {camera.width_px}x{camera.height_px} px, got ({x_px:g}, {y_px:g})")
    return camera.world_from_camera[:3, 3], rays(camera, np.array([[x_px, y_px]]))[0]


def _table_depth_m(eye_m: Float[np.ndarray, "3"], ray: Float[np.ndarray, "3"], height_m: float = 0.0) -> float:
    """inf where the ray does not fall onto the level plane (up is -y)."""
    if abs(ray[1]) < _PARALLEL:
        return float("inf")
    depth_m = float((-height_m - eye_m[1]) / ray[1])
    return depth_m if depth_m > 0 else float("inf")


def _real_depth_m(occlusion: Occlusion | None, camera: Camera, x_px: float, y_px: float) -> float:
    """Depth measured at the pixel; inf where nothing was."""
    column, row = min(int(x_px), camera.width_px - 1), min(int(y_px), camera.height_px - 1)
    one_pixel = Camera(1, 1, camera.focal_px, (camera.principal_px[0] - column, camera.principal_px[1] - row), camera.camera_from_world)
    depth_m = None if occlusion is None else occlusion.depth_m(one_pixel)
    return float("inf") if depth_m is None else float(depth_m[0, 0])


def _nearest_m(scene: Scene, eye_m: Float[np.ndarray, "3"], ray: Float[np.ndarray, "3"]) -> float:
    """First crossing of a ray with any triangle, from either side (Moeller and Trumbore 1997); in units of the ray's length."""
    corners = [mesh.positions_m[mesh.triangles] for mesh in scene.meshes if len(mesh.triangles)]
    if not corners:
        return float("inf")
    a, b, c = np.concatenate(corners).transpose(1, 0, 2)
    across, along, from_eye = np.cross(ray, c - a), b - a, eye_m - a
    determinant = np.einsum("tk,tk->t", along, across)
    with np.errstate(divide="ignore", invalid="ignore"):
        u = np.einsum("tk,tk->t", from_eye, across) / determinant
        q = np.cross(from_eye, along)
        v = q @ ray / determinant
        depth_m = np.einsum("tk,tk->t", c - a, q) / determinant
    hit = (np.abs(determinant) > _PARALLEL * np.abs(along).max()) & (u >= 0) & (v >= 0) & (u + v <= 1) & (depth_m > 0)
    return float(depth_m[hit].min()) if hit.any() else float("inf")
