"""Drawing: the virtual scene as a lens shows it for one pose, drawn only where it is in the picture, ready to be moved to other poses.

`is_outdated` tells when moving a drawing to the wanted pose would no longer show what a new drawing shows.
"""

import functools
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float, Float32

from mrbokeh.compositing.over import covered_by
from mrbokeh.images.layer import Layer, flatten
from mrbokeh.optics.camera import Camera
from mrbokeh.optics.lens import Lens
from mrbokeh.renderers.base import Renderer
from mrbokeh.scene import SceneRenderer
from mrbokeh.scene.staging.picture_box import NEAREST_M, PictureBox, box_around
from mrbokeh.scene.staging.staged_scene import StagedScene
from mrbokeh.scene.virtual_scene import shadow_layer
from mrbokeh.tracking.world_axes import upright_camera
from viewfinder.stage.occlusion import Occlusion
from viewfinder.stage.reprojection import GRID_PX, LayerDepth, MovableLayer

_INVISIBLE = 1e-4
"""A third of the light that the darkest step of 8-bit sRGB needs."""


@dataclass(frozen=True, eq=False)
class DrawRequest:
    """Request to draw. camera: of the whole frame, in the tracker's world. time_s: since the scene began."""

    camera: Camera
    lens: Lens
    time_s: float = 0.0
    resolution: float = 1.0


@dataclass(frozen=True, eq=False)
class Drawing:
    """Drawing, ready to be moved. None of all: nothing of the scene is in the picture.

    layer: blurred; its camera is upright, that of the request is not. sharp: object and shadow in focus, in the whole box.
    depth_m: of what is sharp; inf where nothing is. lens: of the box's part of the sensor.
    depth_range_m: the nearest and the farthest point that was drawn. extent_m: the least and the largest x, y and z of the scene's points
    in the upright world, seen or not; None where it has none.
    """

    request: DrawRequest
    layer: MovableLayer | None = None
    sharp: MovableLayer | None = None
    depth_m: Float32[np.ndarray, "height width"] | None = None
    lens: Lens | None = None
    depth_range_m: tuple[float, float] = (float("inf"), float("inf"))
    extent_m: Float[np.ndarray, "2 3"] | None = None


@dataclass(frozen=True, eq=False)
class RenderSetup:
    """Set-up of a drawing: a backend for the objects, a renderer for the lens, and what real things hide.

    live: a faster backend for what is drawn again and again; None takes `backend` for that too.
    """

    backend: SceneRenderer
    renderer: Renderer
    depth: LayerDepth
    occlusion: Occlusion | None = None
    live: SceneRenderer | None = None


def draw(staged: StagedScene, request: DrawRequest, render_setup: RenderSetup) -> Drawing:
    """Draw the scene for one pose: the box around its projection and blur, at the resolution asked for."""
    frame = upright_camera(request.camera, staged.description.up)
    points_m = staged.drawn_points_m(request.time_s)
    extent_m = np.stack([points_m.min(axis=0), points_m.max(axis=0)]) if len(points_m) else None
    box = box_around(points_m, frame, request.lens)
    if box is None:
        return Drawing(request, extent_m=extent_m)
    camera, lens = box.cut(frame, request.resolution), box.lens_of(request.lens, frame.width_px)
    layers = sharp_layers(staged, request.time_s, camera, replace(render_setup, backend=render_setup.live or render_setup.backend))
    if render_setup.occlusion is not None:
        layers = [covered_by(layer, render_setup.occlusion.matte(layer.depth_m, camera, frame)) for layer in layers]
    blurred, sharp = render_setup.renderer.render(layers, lens), flatten(layers)
    in_box = MovableLayer(
        rgba=_rgba(sharp),
        dioptres=render_setup.depth.seen_dioptres(_padded(layers), lens),
        camera=camera,
        left_px=box.left_px,
        top_px=box.top_px,
        resolution=request.resolution,
    )
    seen = _trimmed(replace(in_box, rgba=_rgba(blurred)))
    return Drawing(
        request=request,
        layer=seen,
        sharp=in_box,
        depth_m=sharp.depth_m,
        lens=lens,
        depth_range_m=_depth_range_m(points_m, frame),
        extent_m=extent_m,
    )


def _depth_range_m(points_m: Float[np.ndarray, "points 3"], camera: Camera) -> tuple[float, float]:
    depths_m = points_m @ camera.camera_from_world[2, :3] + camera.camera_from_world[2, 3]
    return max(float(depths_m.min()), NEAREST_M), float(depths_m.max())


def sharp_layers(staged: StagedScene, time_s: float, camera: Camera, render_setup: RenderSetup) -> list[Layer]:
    """Return object, then shadow, as `render_setup.backend` draws them."""
    scene, shadow, catcher = staged.scene_at(time_s), staged.description.shadow, staged.catcher
    layers = [render_setup.backend.render(scene, camera)]
    if shadow is not None and catcher is not None and scene.lighting[0] and shadow.strength > 0:
        layers.append(shadow_layer(render_setup.backend, scene, camera, catcher, shadow.strength))
    return layers


def _rgba(layer: Layer) -> Float32[np.ndarray, "height width 4"]:
    return np.ascontiguousarray(np.dstack([layer.rgb, layer.alpha]))


def _padded(layers: Sequence[Layer]) -> Sequence[Layer]:
    """Pad layers to sizes that are multiples of the grid of depths; whole frames need not be."""
    height, width = layers[0].alpha.shape
    below, right = -height % GRID_PX, -width % GRID_PX
    if not below and not right:
        return layers
    pad = ((0, below), (0, right))
    return [
        Layer(np.pad(each.rgb, (*pad, (0, 0))), np.pad(each.alpha, pad), np.pad(each.depth_m, pad, constant_values=np.inf))
        for each in layers
    ]


def _trimmed(layer: MovableLayer) -> MovableLayer | None:
    """Cut to the touched pixels, in whole cells of the grid of depths and whole pixels of the frame; None if there are none."""
    touched = functools.reduce(np.maximum, [np.abs(layer.rgba[..., channel]) for channel in range(4)]) > _INVISIBLE
    rows, columns = np.flatnonzero(touched.any(axis=1)), np.flatnonzero(touched.any(axis=0))
    if not len(rows):
        return None
    # 12 pixels at 3/4 and 8 at 1/2 of the resolution are 16 of the frame's: whole there, and whole cells here.
    step = {1.0: GRID_PX, 0.75: 3 * GRID_PX, 0.5: 2 * GRID_PX}[layer.resolution]
    top, left = rows[0] // step * step, columns[0] // step * step
    bottom, right = -(-(rows[-1] + 1) // step) * step, -(-(columns[-1] + 1) // step) * step
    offset = PictureBox(int(left), int(top), min(int(right), touched.shape[1]) - int(left), min(int(bottom), touched.shape[0]) - int(top))
    return MovableLayer(
        rgba=np.ascontiguousarray(layer.rgba[top:bottom, left:right]),
        dioptres=np.ascontiguousarray(layer.dioptres[top // GRID_PX : -(-bottom // GRID_PX), left // GRID_PX : -(-right // GRID_PX)]),
        camera=offset.cut(layer.camera),
        left_px=layer.left_px + round(left / layer.resolution),
        top_px=layer.top_px + round(top / layer.resolution),
        resolution=layer.resolution,
    )


FARTHEST_PX = 1.0
"""A picture moved by less than this differs from a new one by its resampling alone; the jitter of a tracker on a tripod is below it."""
_COC_PX = 0.25
_MOMENT_S = 1 / 120


def is_outdated(drawing: Drawing, wanted: DrawRequest, is_animated: bool) -> bool:
    """Tell whether to draw again for what is wanted. The resolution of neither counts."""
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
    """Return how far anything of the drawing moves at most, when it is moved to a camera of the same world as the request's."""
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
    """Tell whether circles of confusion differ by a quarter of a pixel, or their shape at all."""
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
