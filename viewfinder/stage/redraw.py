"""When a drawing is too old: once moving it to the wanted pose would no longer show what a new drawing shows."""

from dataclasses import replace

import numpy as np
from jaxtyping import Float

from mrbokeh.optics.camera import Camera
from mrbokeh.optics.lens import Lens
from viewfinder.stage.drawn_layer import Drawing, DrawRequest

FARTHEST_PX = 1.0
"""A picture moved by less than this differs from a new one by its resampling alone; the jitter of a tracker on a tripod is below it."""
_COC_PX = 0.25
_MOMENT_S = 1 / 120


def is_outdated(drawing: Drawing, wanted: DrawRequest, is_animated: bool) -> bool:
    """Whether to draw again for what is wanted. The resolution of neither counts."""
    drawn = drawing.request
    if is_animated and abs(wanted.time_s - drawn.time_s) >= _MOMENT_S:
        return True
    if (drawn.camera.width_px, drawn.camera.height_px) != (wanted.camera.width_px, wanted.camera.height_px):
        return True
    if drawing.layer is None:
        return drawn.lens != wanted.lens or not is_same_view(drawn.camera, wanted.camera)
    return blur_changed(drawn.lens, wanted.lens, drawing) or moved_px(drawing, wanted.camera) > FARTHEST_PX


def is_same_view(one: Camera, other: Camera) -> bool:
    same_pinhole = (one.focal_px, one.principal_px) == (other.focal_px, other.principal_px)
    return same_pinhole and np.array_equal(one.camera_from_world, other.camera_from_world)


def moved_px(drawing: Drawing, camera: Camera) -> float:
    """How far anything of the drawing moves in the picture at most, when it is moved to a camera of the same world as the request's."""
    drawn, layer = drawing.request.camera, drawing.layer
    if layer is None:
        return 0.0
    right, down = layer.camera.width_px / layer.resolution, layer.camera.height_px / layer.resolution
    corners_px = np.array([[layer.left_px + x * right, layer.top_px + y * down] for x in (0, 1) for y in (0, 1)])
    return max(_farthest_px(corners_px, depth_m, drawn, camera) for depth_m in drawing.depth_range_m)


def _farthest_px(corners_px: Float[np.ndarray, "4 2"], depth_m: float, drawn: Camera, camera: Camera) -> float:
    moved_to_px, ahead_m = camera.project(drawn.unproject(corners_px, np.full(4, depth_m)))
    return float(np.linalg.norm(moved_to_px - corners_px, axis=1).max()) if (ahead_m > 0).all() else float("inf")


def blur_changed(drawn: Lens, wanted: Lens, drawing: Drawing) -> bool:
    """Whether circles of confusion differ by a quarter of a pixel, or their shape at all."""
    if drawn == wanted:
        return False
    same_optics = replace(
        drawn,
        focal_length_mm=wanted.focal_length_mm,
        f_number=wanted.f_number,
        focus_distance_m=wanted.focus_distance_m,
        sensor_width_mm=wanted.sensor_width_mm,
    )
    if same_optics != wanted or not wanted.has_flat_focus:
        return True
    depths_m, width_px = np.array(drawing.depth_range_m), drawing.request.camera.width_px
    return bool(np.abs(drawn.coc_px(depths_m, width_px) - wanted.coc_px(depths_m, width_px)).max() > _COC_PX)
