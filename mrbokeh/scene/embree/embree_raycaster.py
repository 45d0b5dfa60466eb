"""EmbreeRaycaster: virtual scenes to Layers on any CPU, by Embree's rays (Wald et al. 2014) and compiled shading.

The camera of a ray caster: which pixels a scene can be seen in, and the rays through points of the picture.
"""

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from copy import copy
from typing import TypeVar

import cv2
import numpy as np
from jaxtyping import Bool, Float, Float32, Float64, Int64

from mrbokeh.images.layer import Layer, clear
from mrbokeh.layering.pixel_box import NOWHERE, Box
from mrbokeh.optics.camera import Camera
from mrbokeh.scene.embree.prepared_scenes import (
    SAMPLE_COUNTS,
    PlacedScene,
    PreparedScene,
    PreparedScenes,
    edge_pixels,
    sample_offsets_px,
    silhouette_pixels,
)
from mrbokeh.scene.embree.shading import RaySamples, lit_share, shaded
from mrbokeh.scene.light import Light
from mrbokeh.scene.mesh import Mesh
from mrbokeh.scene.virtual_scene import Scene
from mrbokeh.system.errors import InputError
from mrbokeh.system.resources import cores

ROWS_AT_ONCE = 512
_ROOM_PX = 2

_RAYS_AT_ONCE = 1 << 14
"""So few that the shading points of one part stay in the processor's cache, and that Python's lock is free again after 2 ms."""
_EDGES_AT_ONCE = 1 << 15
_Result = TypeVar("_Result")


class EmbreeRaycaster:
    """A SceneRenderer that needs nothing but pip packages: `embreex` and `numba`.

    One ray through each pixel's centre gives colour, exact depth and coverage; only pixels at edges get 4x4 more. Lights cast
    hard shadows, partly through BLEND surfaces. The environment lights without shadows of its own.

    What a scene and a panorama need before the first picture is kept as long as they live, so a film of one Scene under many
    cameras is cheap, and so is one Scene moved as a rigid body. Memory is bounded by tracing 16384 rays at a time in each of
    `threads` threads.
    """

    def __init__(self, threads: int | None = None, edge_samples: int = 16, shadow_step_px: int = 1) -> None:
        """Set up the ray caster.

        threads: None or 0 uses all cores.

        Two settings make pictures quicker that are drawn again and again. edge_samples: rays in a pixel at an edge, 16 or 4; with 4,
        coverage at an edge has steps of a quarter. shadow_step_px: shadow masks are traced at every n-th pixel only and interpolated
        between.
        """
        if (threads or 0) < 0:
            raise InputError(f"expected a number of threads from 0 up, got {threads}: 0 takes all cores")
        self._threads = threads or cores()
        self._offsets, self._shadow_step_px = _checked(edge_samples, shadow_step_px)
        self._kept = PreparedScenes()

    def with_quality(self, edge_samples: int = 16, shadow_step_px: int = 1) -> "EmbreeRaycaster":
        """Another ray caster that shares what this one has prepared and will prepare."""
        other = copy(self)
        other._offsets, other._shadow_step_px = _checked(edge_samples, shadow_step_px)
        return other

    def render(self, scene: Scene, camera: Camera) -> Layer:
        """The scene as the camera sees it, without lens blur; see SceneRenderer."""
        placed = self._kept.placed(scene)
        layer = clear(camera.height_px, camera.width_px)
        if placed is None:
            return layer
        box = picture_box(placed.ready, placed.camera(camera))
        if box.is_empty:
            return layer
        part = self._rendered(placed, scene, box.camera_of(placed.camera(camera)))
        layer.rgb[box.where], layer.alpha[box.where], layer.depth_m[box.where] = part.rgb, part.alpha, part.depth_m
        return layer

    def _rendered(self, placed: PlacedScene, scene: Scene, camera: Camera) -> Layer:
        """The whole picture of a camera in the prepared scene's axes."""
        height, width = camera.height_px, camera.width_px
        directions = ray_directions(camera, camera.pixel_centres_px().reshape(-1, 2))
        centres = self._traced(placed, scene, camera, directions, pixel_share=1.0)
        rgb, alpha, depth_m = centres.rgb.copy(), centres.alpha.copy(), centres.depth_m.copy()

        edges, count = np.flatnonzero(_edges(placed.ready, camera, directions, centres)), len(self._offsets)
        for some in np.array_split(edges, max(1, len(edges) // _EDGES_AT_ONCE)):
            samples = self._traced(placed, scene, camera, ray_directions(camera, self._within(some, width)), pixel_share=count**-0.5)
            rgb[some] = samples.rgb.reshape(-1, count, 3).mean(1)
            alpha[some] = samples.alpha.reshape(-1, count).mean(1)
            nearest_m = samples.depth_m.reshape(-1, count).min(1)
            depth_m[some] = np.where(np.isfinite(depth_m[some]), depth_m[some], nearest_m)
        depth_m = np.where(alpha > 0, depth_m, np.inf).astype(np.float32)
        return Layer(rgb.reshape(height, width, 3), alpha.reshape(height, width), depth_m.reshape(height, width))

    def render_shadow_mask(self, scene: Scene, camera: Camera, catcher: Mesh) -> Float32[np.ndarray, "height width"]:
        """Return the (H, W) share of the lights' irradiance that reaches the catcher past the scene, 1 is lit; see SceneRenderer."""
        placed = self._kept.placed(scene)
        if placed is None or not scene.lighting[0]:
            return np.ones((camera.height_px, camera.width_px), np.float32)
        step = self._shadow_step_px
        if step == 1:
            return self._shadow_mask(placed, scene.lighting[0], camera, catcher)
        columns, rows = -(-camera.width_px // step), -(-camera.height_px // step)
        covering = Camera(
            width_px=columns * step,
            height_px=rows * step,
            focal_px=camera.focal_px,
            principal_px=camera.principal_px,
            camera_from_world=camera.camera_from_world,
        )
        mask = self._shadow_mask(placed, scene.lighting[0], covering.resized(columns, rows), catcher)
        whole = cv2.resize(mask, (columns * step, rows * step), interpolation=cv2.INTER_LINEAR)
        return np.ascontiguousarray(whole[: camera.height_px, : camera.width_px])

    def _shadow_mask(
        self, placed: PlacedScene, lights: Sequence[Light], camera: Camera, catcher: Mesh
    ) -> Float32[np.ndarray, "height width"]:
        ground, world_from_ready = self._kept.ground(catcher), placed.world_from_ready
        height, width, eye_m = camera.height_px, camera.width_px, camera.world_from_camera[:3, 3]

        def lit(xy_px: Float[np.ndarray, "points 2"]) -> Float32[np.ndarray, " points"]:
            directions = ray_directions(camera, xy_px)
            parts = self._in_threads(lambda part: lit_share(placed.ready, ground, lights, world_from_ready, eye_m, part), directions)
            return np.concatenate(parts)

        mask = np.concatenate([lit(row_centres_px(camera, first)) for first in range(0, height, ROWS_AT_ONCE)])
        edges = np.flatnonzero(_steps(mask.reshape(height, width)))
        if len(edges):
            mask[edges] = lit(self._within(edges, width)).reshape(-1, len(self._offsets)).mean(1)
        return mask.reshape(height, width)

    def _within(self, pixels: Int64[np.ndarray, " pixels"], width_px: int) -> Float64[np.ndarray, "samples 2"]:
        """The points of pixels (row after row) at which edges are sampled."""
        corner = np.stack([pixels % width_px, pixels // width_px], axis=-1)
        return (corner[:, None] + self._offsets).reshape(-1, 2)

    def _traced(
        self, placed: PlacedScene, scene: Scene, camera: Camera, directions: Float[np.ndarray, "rays 3"], pixel_share: float
    ) -> RaySamples:
        """Rays from the camera, shaded. pixel_share: the width of what a ray stands for, in pixels."""
        maps = placed.maps(self._kept.maps(scene))
        footprint = pixel_share / float(np.sqrt(camera.focal_px[0] * camera.focal_px[1]))
        eye_m = camera.world_from_camera[:3, 3]
        return RaySamples.joined(
            self._in_threads(lambda part: shaded(placed.ready, eye_m, part, footprint, placed.lights, maps), directions)
        )

    def _in_threads(self, work: Callable[[Float[np.ndarray, "some 3"]], _Result], directions: Float[np.ndarray, "rays 3"]) -> list[_Result]:
        """Embree's binding holds Python's lock, the compiled shading does not: so one part is traced while others are shaded."""
        parts = np.array_split(directions, max(1, -(-len(directions) // _RAYS_AT_ONCE)))
        if self._threads == 1 or len(parts) == 1:
            return [work(part) for part in parts]
        with ThreadPoolExecutor(self._threads) as pool:
            return list(pool.map(work, parts))


def picture_box(ready: PreparedScene, camera: Camera) -> Box:
    """Return the box of pixels that may show the scene; the whole picture if the camera is within the scene's box or before it."""
    signs = np.array(np.meshgrid((-1.0, 1.0), (-1.0, 1.0), (-1.0, 1.0))).reshape(3, -1).T
    low, high, size = np.zeros(2), np.zeros(2), np.array([camera.width_px, camera.height_px])
    corners_m = ready.centre_m + signs * ready.half_size_m
    ahead_m = corners_m @ camera.camera_from_world[2, :3] + camera.camera_from_world[2, 3]
    if ahead_m.max() <= 0:
        return NOWHERE
    if ahead_m.min() <= 1e-3 * ready.reach_m:
        return Box(0, camera.height_px, 0, camera.width_px)
    xy_px, _ = camera.project(corners_m)
    low, high = (np.clip(each, -_ROOM_PX, size + _ROOM_PX) for each in (np.floor(xy_px.min(0)), np.ceil(xy_px.max(0))))
    (left, top), (right, bottom) = (np.clip(each, 0, size).astype(int).tolist() for each in (low - _ROOM_PX, high + _ROOM_PX))
    return Box(top, bottom, left, right)


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


def _checked(edge_samples: int, shadow_step_px: int) -> tuple[Float[np.ndarray, "samples 2"], int]:
    if edge_samples not in SAMPLE_COUNTS:
        raise InputError(f"expected {' or '.join(map(str, SAMPLE_COUNTS))} as edge_samples, got {edge_samples}: take one of these")
    if shadow_step_px < 1:
        raise InputError(f"expected whole pixels from 1 on as shadow_step_px, got {shadow_step_px}: take 1 to look at every pixel")
    return sample_offsets_px(edge_samples), shadow_step_px


def _edges(
    ready: PreparedScene, camera: Camera, directions: Float64[np.ndarray, "rays 3"], centres: RaySamples
) -> Bool[np.ndarray, "height width"]:
    """Pixels whose centre does not speak for all of the pixel."""
    size = camera.height_px, camera.width_px
    depth_m = centres.depth_m.reshape(size)
    mesh, alpha, lit = (values.reshape(size) for values in (centres.mesh, centres.alpha, centres.lit))
    edges = edge_pixels(mesh, alpha, depth_m, centres.normal.reshape(*size, 3), lit, directions.reshape(*size, 3))
    outlines_m = ready.edges.seen_from(camera.world_from_camera[:3, 3] - ready.centre_m) + ready.centre_m
    in_camera_m = outlines_m @ camera.camera_from_world[:3, :3].T + camera.camera_from_world[:3, 3]
    return edges | silhouette_pixels(in_camera_m, camera.focal_px, camera.principal_px, depth_m)


def _steps(mask: Float32[np.ndarray, "height width"]) -> Bool[np.ndarray, "height width"]:
    """Pixels that differ from one of their eight neighbours."""
    around = np.ones((3, 3), np.uint8)
    return cv2.dilate(mask, around) - cv2.erode(mask, around) > 0.02
