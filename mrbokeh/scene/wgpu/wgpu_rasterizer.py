"""WgpuRasterizer: virtual scenes to Layers on any graphics device, by wgpu (Vulkan, Metal, Direct3D 12)."""

from collections import OrderedDict
from collections.abc import Hashable, Iterator
from dataclasses import dataclass, replace
from typing import Any, TypeVar
from weakref import WeakKeyDictionary

import numpy as np
from jaxtyping import Float32, Float64, UInt32

from mrbokeh.images.layer import Layer, clear
from mrbokeh.layering.pixel_box import Box
from mrbokeh.optics.camera import Camera
from mrbokeh.scene.environment_filter import lighting_maps
from mrbokeh.scene.light import Environment
from mrbokeh.scene.material import Material, Texture
from mrbokeh.scene.mesh import Mesh
from mrbokeh.scene.virtual_scene import Scene
from mrbokeh.scene.wgpu._depth_numba import fill_depth
from mrbokeh.scene.wgpu.device import gpu
from mrbokeh.scene.wgpu.geometry import GpuGeometry, TexelPool, texel_pool, uploaded
from mrbokeh.scene.wgpu.shading import Canvas, GpuPanorama, Job, Lighting, Shading, lights_with_shadows, no_panorama, panorama
from mrbokeh.scene.wgpu.visibility import Visibility, nearest_m, sample_places, targets, tiles
from mrbokeh.system.errors import InputError

_TILE_PX = (2048, 512)
_ROUNDED_TO_PX = 64
_KEPT_POOLS, _KEPT_CANVASES = 2, 6
_MOST_LAYERS, _VEILS = 8, 3
_Kept = TypeVar("_Kept")


@dataclass(frozen=True, eq=False)
class _Ready:
    """A scene on the device with what lights it. group binds the geometry."""

    geometry: GpuGeometry
    group: Any
    lighting: Lighting


class WgpuRasterizer:
    """A SceneRenderer on the graphics device: it draws triangle numbers at 17 samples per pixel, then shades what they see.

    Shading follows the ray caster formula by formula (the shaders name their models). Only pixels in which different surfaces meet
    are shaded more than once. Depth is worked out from the triangle in double precision on the processor.

    Lights' shadows come from maps of triangle numbers whose triangles are then met exactly (shadow.wgsl). The maps are made once
    per scene: moving the camera uploads a few hundred bytes. A new pose of an animated mesh is a new Scene, whose triangles are
    uploaded again, while its textures stay.

    Limits: of blended surfaces 8 are seen through, and 3 dim a light; triangles smaller than a texel of the
    shadow map (1/`shadow_map_px` of the scene) have shadows with borders as coarse as the texel.
    """

    def __init__(self, shadow_map_px: int = 2048) -> None:
        if not 16 <= shadow_map_px <= 8192:
            raise InputError(f"expected shadow maps of 16 to 8192 px, got {shadow_map_px}")
        self._gpu = gpu()
        self._visibility = Visibility(self._gpu)
        self._shading = Shading(self._gpu, self._visibility)
        self._shadow_map_px = shadow_map_px
        self._scenes: WeakKeyDictionary[Scene, _Ready] = WeakKeyDictionary()
        self._grounds: WeakKeyDictionary[Mesh, tuple[GpuGeometry, Any]] = WeakKeyDictionary()
        self._panoramas: WeakKeyDictionary[Environment, GpuPanorama] = WeakKeyDictionary()
        self._no_panorama = no_panorama(self._gpu)
        self._pools: OrderedDict[Hashable, TexelPool] = OrderedDict()
        self._canvases: OrderedDict[Hashable, Canvas] = OrderedDict()

    def render(self, scene: Scene, camera: Camera) -> Layer:
        """The scene as the camera sees it, without lens blur; see SceneRenderer."""
        picture = clear(camera.height_px, camera.width_px)
        ready = self._ready(scene)
        if ready is None:
            return picture
        for place, part in _parts(camera, ready.geometry):
            canvas = self._drawn(
                Job(geometry=ready.geometry, group=ready.group, shading_group=ready.group, camera=part, lighting=ready.lighting)
            )
            rgba, deciding = self._shading.read(canvas, part)
            picture.rgb[place], picture.alpha[place] = rgba[..., :3], rgba[..., 3]
            depth_m = _exact_depth_m(ready.geometry, part, deciding)
            picture.depth_m[place] = np.where(rgba[..., 3] > 0, depth_m, np.inf)
        return picture

    def render_shadow_mask(self, scene: Scene, camera: Camera, catcher: Mesh) -> Float32[np.ndarray, "height width"]:
        """Return the (H, W) share of the lights' irradiance that reaches the catcher past the scene, 1 is lit; see SceneRenderer."""
        mask = np.ones((camera.height_px, camera.width_px), np.float32)
        ready = self._ready(scene)
        if ready is None or not scene.lighting[0] or not len(catcher.triangles):
            return mask
        ground, group = self._ground(catcher)
        shading_group = self._visibility.geometry_group(ground, materials_of=ready.geometry)
        for place, part in _parts(camera, ground):
            mask[place] = self._shading.read_mask(
                self._drawn(
                    Job(geometry=ground, group=group, shading_group=shading_group, camera=part, lighting=ready.lighting, is_mask=True)
                ),
                part,
            )
        return mask

    def _drawn(self, job: Job) -> Canvas:
        """Draw and shade a tile: what is blended layer by layer from the front, then what is solid."""
        near_m = nearest_m(job.camera, job.geometry.centre_m, job.geometry.box_m)
        canvas, layer = self._canvas(job), 0
        encoder = self._gpu.device.create_command_encoder()
        self._visibility.draw_camera(encoder, job.geometry, job.group, job.camera, canvas.targets, None, near_m)
        for layer in range(_MOST_LAYERS if job.layered else 0):
            self._visibility.draw_camera(encoder, job.geometry, job.group, job.camera, canvas.targets, layer, near_m)
            self._shading.run(encoder, job, canvas, layer, is_last=False)
            self._gpu.device.queue.submit([encoder.finish()])
            encoder = self._gpu.device.create_command_encoder()
            if self._shading.is_done(canvas):
                break
        self._shading.run(encoder, job, canvas, layer + 1 if job.layered else 0, is_last=True)
        self._gpu.device.queue.submit([encoder.finish()])
        return canvas

    def _canvas(self, job: Job) -> Canvas:
        """Room for the tile; sizes are rounded up, so that an object that moves through the picture finds room that is there."""
        width, height = (-(-size // _ROUNDED_TO_PX) * _ROUNDED_TO_PX for size in (job.camera.width_px, job.camera.height_px))
        key = (width, height, job.layered)
        return _kept(self._canvases, key, _KEPT_CANVASES) or _keep(
            self._canvases, key, self._shading.canvas(targets(self._gpu, (width, height), job.layered), job.layered)
        )

    def _pool(self, textures: tuple[Texture, ...]) -> TexelPool:
        key = tuple(map(id, textures))
        return _kept(self._pools, key, _KEPT_POOLS) or _keep(self._pools, key, texel_pool(self._gpu, textures))

    def _ready(self, scene: Scene) -> _Ready | None:
        """Return the data that depend on the scene only; None if there is nothing to draw."""
        if scene in self._scenes:
            return self._scenes[scene]
        drawn = scene.drawn_meshes
        if not drawn:
            return None
        geometry = uploaded(self._gpu, drawn, self._pool)
        group = self._visibility.geometry_group(geometry)
        lights, environment = scene.lighting
        shadows = lights_with_shadows(self._gpu, self._visibility, geometry, group, lights, self._shadow_map_px, _VEILS)
        self._scenes[scene] = _Ready(geometry, group, Lighting(geometry, shadows, self._panorama(environment)))
        return self._scenes[scene]

    def _ground(self, catcher: Mesh) -> tuple[GpuGeometry, Any]:
        """A catcher by itself, receiving light from the side that is seen."""
        if catcher not in self._grounds:
            geometry = uploaded(self._gpu, [replace(catcher, material=Material(double_sided=True))], self._pool)
            self._grounds[catcher] = geometry, self._visibility.geometry_group(geometry)
        return self._grounds[catcher]

    def _panorama(self, environment: Environment | None) -> GpuPanorama:
        if environment is None:
            return self._no_panorama
        if environment not in self._panoramas:
            self._panoramas[environment] = panorama(self._gpu, lighting_maps(environment))
        return self._panoramas[environment]


def _kept(cache: OrderedDict[Hashable, _Kept], key: Hashable, most: int) -> _Kept | None:
    """An entry, which so becomes the newest; where there is none, room is made for it."""
    if key in cache:
        cache.move_to_end(key)
        return cache[key]
    while len(cache) >= most:
        cache.popitem(last=False)
    return None


def _keep(cache: OrderedDict[Hashable, _Kept], key: Hashable, value: _Kept) -> _Kept:
    cache[key] = value
    return value


def _parts(camera: Camera, geometry: GpuGeometry) -> Iterator[tuple[tuple[slice, slice], Camera]]:
    """The part of the picture in which the geometry's box lies, in tiles: (where, camera of the tile)."""
    first, end = (0, 0), (camera.width_px, camera.height_px)
    box_m = geometry.box_m + geometry.centre_m
    if (box_m @ camera.camera_from_world[2, :3] + camera.camera_from_world[2, 3]).min() > 0:
        corners_px, _ = camera.project(box_m)
        low, high = np.floor(corners_px.min(0)) - 1, np.ceil(corners_px.max(0)) + 1
        (x, y), (end_x, end_y) = np.clip([low, high], (0, 0), end).astype(int).tolist()
        first, end = (x, y), (end_x, end_y)
    for x, y, width, height in tiles(first, end, _TILE_PX):
        box = Box(y, y + height, x, x + width)
        yield box.where, box.camera_of(camera)


def _exact_depth_m(
    geometry: GpuGeometry, camera: Camera, deciding: UInt32[np.ndarray, "height width"]
) -> Float64[np.ndarray, "height width"]:
    depth_m = np.empty(deciding.shape)
    eye = (camera.world_from_camera[:3, 3] - geometry.centre_m)[None]
    axes = np.ascontiguousarray(camera.camera_from_world[:3, :3])
    intrinsics = np.array([*camera.focal_px, *camera.principal_px], np.float64)
    places = np.concatenate([sample_places()[0], [[0.5, 0.5]]])
    fill_depth(deciding, geometry.corners_m, eye, axes, intrinsics, places, depth_m)
    return depth_m
