"""ShownScene: what the newest frame shows of the scene: the views of the page, what lies under a point, and the ground for dragging.

Where nothing of the scene is seen, the reasons come in a sentence and an arrow for the page.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
from jaxtyping import Bool, Float, Float32, UInt8

from mrbokeh.compositing.overlay import CodeTables, Overlay
from mrbokeh.optics.camera import Camera
from mrbokeh.scene import Scene
from mrbokeh.scene.staging.picture_box import NEAREST_M
from mrbokeh.scene.staging.scene_description import PlacedObject
from mrbokeh.scene.staging.staged_scene import StagedScene
from mrbokeh.system.compiled import kernels_compiled
from mrbokeh.system.errors import InputError
from mrbokeh.tracking.world_axes import rays, upright_camera
from viewfinder.frames import Bgr, Remark
from viewfinder.stage.drawing import Drawing
from viewfinder.stage.occlusion import Occlusion

_MIDDLE = 1e-6


@dataclass(frozen=True, eq=False)
class ShownScene:
    """Scene as the newest frame shows it. camera: upright. drawing: the one that was moved to it to become the overlay."""

    overlay: Overlay
    camera: Camera
    drawing: Drawing
    staged: StagedScene
    occlusion: Occlusion | None = None


Plane = Float32[np.ndarray, "height width"]
_LEAST = 1e-3
_SAME_DIOPTRES = 1e-3


def view_picture(view: str, plate_bgr: Bgr, seen: ShownScene | None, tables: CodeTables) -> Bgr:
    """Paint one of VIEWS. seen: None before the first drawing, when only the plate shows anything. InputError for an unknown name.

    matte: white is all virtual, a shadow counts by how dark it is. depth: red is near, blue far, by 1 / depth over what is seen.
    coc: white is in focus, red behind, blue in front; full colour is the largest circle of confusion that is seen, 1 px at least.
    """
    if view not in _PAINTERS:
        raise InputError(f"expected a view ({', '.join(VIEWS)}), got {view!r}")
    if seen is None:
        return plate_bgr if view in ("plate", "final") else np.zeros_like(plate_bgr)
    return _PAINTERS[view](plate_bgr, seen, tables)


def _plate(plate_bgr: Bgr, seen: ShownScene, tables: CodeTables) -> Bgr:  # noqa: ARG001
    return plate_bgr


def _final(plate_bgr: Bgr, seen: ShownScene, tables: CodeTables) -> Bgr:
    return seen.overlay.over_codes(plate_bgr, tables)


def _virtual(plate_bgr: Bgr, seen: ShownScene, tables: CodeTables) -> Bgr:
    return seen.overlay.over_codes(np.zeros_like(plate_bgr), tables)


def _matte(plate_bgr: Bgr, seen: ShownScene, tables: CodeTables) -> Bgr:  # noqa: ARG001
    alpha = np.rint(255.0 * np.clip(1.0 - seen.overlay.shines_through, 0.0, 1.0)).astype(np.uint8)
    return _placed(np.repeat(alpha[..., None], 3, axis=2), seen.overlay, plate_bgr)


def _depth(plate_bgr: Bgr, seen: ShownScene, tables: CodeTables) -> Bgr:  # noqa: ARG001
    if seen.drawing.depth_m is None:
        return np.zeros_like(plate_bgr)
    overlay, dioptres, there = _moved((1.0 / seen.drawing.depth_m).astype(np.float32), seen)
    known = dioptres[there]
    far, near = (float(known.min()), float(known.max())) if len(known) else (0.0, 1.0)
    nearness = np.clip((dioptres - far) / max(near - far, _SAME_DIOPTRES), 0.0, 1.0)
    colours = cv2.applyColorMap(np.rint(255.0 * nearness).astype(np.uint8), cv2.COLORMAP_JET)
    return _placed(np.where(there[..., None], colours, 0).astype(np.uint8), overlay, plate_bgr)


def _coc(plate_bgr: Bgr, seen: ShownScene, tables: CodeTables) -> Bgr:  # noqa: ARG001
    drawing = seen.drawing
    if drawing.sharp is None or drawing.depth_m is None or drawing.lens is None:
        return np.zeros_like(plate_bgr)
    coc_px = drawing.lens.coc_px(drawing.depth_m, drawing.depth_m.shape[1]) / drawing.request.resolution
    overlay, coc_px, there = _moved(np.where(np.isfinite(drawing.depth_m), coc_px, 0.0).astype(np.float32), seen)
    share = np.clip(coc_px / max(float(np.abs(coc_px[there]).max(initial=0.0)), 1.0), -1.0, 1.0)
    blue, red = 1.0 - np.maximum(share, 0.0), 1.0 + np.minimum(share, 0.0)
    colours = np.rint(255.0 * np.stack([blue, np.minimum(blue, red), red], axis=2))
    return _placed(np.where(there[..., None], colours, 0).astype(np.uint8), overlay, plate_bgr)


def _moved(values: Plane, seen: ShownScene) -> tuple[Overlay, Float32[np.ndarray, "rows columns"], Bool[np.ndarray, "rows columns"]]:
    """Move values of the sharp picture to the newest one: (where, the values, whether there is anything)."""
    sharp = seen.drawing.sharp
    assert sharp is not None, "a drawing with depth has a sharp layer"
    alpha = sharp.rgba[..., 3]
    weighted = np.stack([values * alpha, np.zeros_like(alpha), np.zeros_like(alpha), alpha], axis=2)
    overlay = replace(sharp, rgba=np.ascontiguousarray(weighted)).moved_to(seen.camera)
    weight = 1.0 - overlay.shines_through
    there = weight > _LEAST
    mean = np.zeros_like(weight)
    np.divide(overlay.rgb[..., 0], weight, out=mean, where=there)
    return overlay, mean, there


def _placed(colours: UInt8[np.ndarray, "rows columns 3"], overlay: Overlay, plate_bgr: Bgr) -> Bgr:
    """Return a picture as large as the plate, black outside the overlay's box."""
    result = np.zeros_like(plate_bgr)
    height, width = overlay.shines_through.shape
    result[overlay.top_px : overlay.top_px + height, overlay.left_px : overlay.left_px + width] = colours
    return result


_PAINTERS: dict[str, Callable[[Bgr, ShownScene, CodeTables], Bgr]] = {
    "final": _final,
    "plate": _plate,
    "virtual": _virtual,
    "matte": _matte,
    "depth": _depth,
    "coc": _coc,
}
VIEWS = tuple(_PAINTERS)


_FARTHEST_M = 100.0
_PARALLEL = 1e-12


def object_at(seen: ShownScene, x_px: float, y_px: float) -> tuple[str, float] | None:
    """Return name and depth (metres, along the axis) of the virtual object at a point of the newest picture; None where there is none."""
    eye_m, ray = _ray(seen.camera, x_px, y_px)
    parts = seen.staged.parts_at(seen.drawing.request.time_s)
    met = [(_nearest_m(scene, eye_m, ray), name) for name, scene in parts.items()]
    depth_m, name = min(met, default=(float("inf"), ""))
    real_m = _real_depth_m(seen.occlusion, seen.camera, x_px, y_px)
    return (name, depth_m) if depth_m < min(real_m, _FARTHEST_M) else None


def depth_at_m(seen: ShownScene, x_px: float, y_px: float) -> float:
    """Return the depth a tap focuses on: of the virtual object, else as measured, else of the table. InputError for none of them."""
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


def _table_depth_m(eye_m: Float[np.ndarray, "3"], ray: Float[np.ndarray, "3"]) -> float:
    """Return the depth of the level plane (up is -y); inf where the ray does not fall onto it."""
    if abs(ray[1]) < _PARALLEL:
        return float("inf")
    depth_m = float(-eye_m[1] / ray[1])
    return depth_m if depth_m > 0 else float("inf")


def _real_depth_m(occlusion: Occlusion | None, camera: Camera, x_px: float, y_px: float) -> float:
    """Return the depth measured at the pixel; inf where nothing was."""
    column, row = min(int(x_px), camera.width_px - 1), min(int(y_px), camera.height_px - 1)
    one_pixel = Camera(
        width_px=1,
        height_px=1,
        focal_px=camera.focal_px,
        principal_px=(camera.principal_px[0] - column, camera.principal_px[1] - row),
        camera_from_world=camera.camera_from_world,
    )
    depth_m = None if occlusion is None else occlusion.depth_m(one_pixel)
    return float("inf") if depth_m is None else float(depth_m[0, 0])


def _nearest_m(scene: Scene, eye_m: Float[np.ndarray, "3"], ray: Float[np.ndarray, "3"]) -> float:
    """Return the first crossing of a ray with any triangle, from either side (Moeller and Trumbore 1997), in lengths of the ray."""
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


_LEAST_DETERMINANT = 1e-12


def ground_from_picture(camera: Camera, up: str) -> Float[np.ndarray, "3 3"] | None:
    """Return the homography from (x, y, 1), 0 to 1 right and down in the picture, to (x, z) in metres on the table.

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


def preparing(busy: bool) -> str:
    """Say what keeps the first drawing. busy: it has been begun."""
    if not busy:
        return "the scene waits for the first picture of a camera whose place is known"
    count = kernels_compiled()
    done = f"compiling for this machine, kernel {count}: " if count else ""
    return f"preparing the scene; {done}the first time on a machine that takes a minute"


def reason_unseen(objects: Sequence[PlacedObject], extent_m: Float[np.ndarray, "2 3"] | None, camera: Camera) -> Remark:
    """Return why nothing of a drawn scene is in the picture of an upright camera.

    extent_m: the least and the largest coordinates of its points. The arrow points from the middle of the picture to where they are.
    """
    if not any(each.visible for each in objects):
        return Remark("every object is hidden: show one" if objects else "the scene has no object: add one to the scene file")
    if extent_m is None:
        return Remark("the objects of the scene have no surfaces: choose other files for them")
    corners_m = np.array([[extent_m[i, 0], extent_m[j, 1], extent_m[k, 2]] for i in (0, 1) for j in (0, 1) for k in (0, 1)])
    middle_m, seen_m = (
        points_m @ camera.camera_from_world[:3, :3].T + camera.camera_from_world[:3, 3] for points_m in (extent_m.mean(axis=0), corners_m)
    )
    if seen_m[:, 2].max() < NEAREST_M:
        return Remark("the object is behind the camera: turn round, along the arrow", _direction(middle_m, camera))
    xy_px = middle_m[:2] / max(middle_m[2], NEAREST_M) * camera.focal_px + camera.principal_px
    if middle_m[2] > NEAREST_M and (xy_px >= 0).all() and (xy_px <= (camera.width_px, camera.height_px)).all():
        return Remark("the object is in the picture, but nothing of it can be seen: it is hidden, far too small or far too blurred")
    return Remark("the object is outside the picture: turn the camera along the arrow", _direction(middle_m, camera))


def _direction(middle_m: Float[np.ndarray, "3"], camera: Camera) -> tuple[float, float]:
    """Return right and down, of length 1; where it is straight behind, right is as good as any."""
    towards = middle_m[:2] * camera.focal_px
    length = float(np.linalg.norm(towards))
    return (1.0, 0.0) if length < _MIDDLE else (float(towards[0]) / length, float(towards[1]) / length)
