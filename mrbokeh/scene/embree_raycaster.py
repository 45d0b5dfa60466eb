"""EmbreeRaycaster: virtual scenes to Layers on any CPU, by Embree's rays (Wald et al. 2014) and compiled shading."""

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from typing import TypeVar
from weakref import WeakKeyDictionary

import numpy as np
from jaxtyping import Bool, Float, Float32, Float64

from mrbokeh.camera import Camera
from mrbokeh.errors import InputError
from mrbokeh.layer import Layer, clear
from mrbokeh.scene.embree_scene import PreparedScene, RaySamples, prepared
from mrbokeh.scene.environment import Environment
from mrbokeh.scene.environment_filter import LightingMaps, lighting_maps
from mrbokeh.scene.light import Light
from mrbokeh.scene.material import Material
from mrbokeh.scene.mesh import Mesh
from mrbokeh.scene.pixel_edges import edge_pixels, sixteen_offsets_px
from mrbokeh.scene.silhouettes import silhouette_pixels
from mrbokeh.scene.virtual_scene import Scene
from mrbokeh.workers import cores

_RAYS_AT_ONCE = 1 << 16
_Result = TypeVar("_Result")


class EmbreeRaycaster:
    """A SceneRenderer that needs nothing but pip packages: `embreex` and `numba`.

    One ray through each pixel's centre gives colour, exact depth and coverage; only pixels at edges get 4x4 more. Lights cast
    hard shadows, partly through BLEND surfaces. The environment lights without shadows of its own.

    What a scene and a panorama need before the first picture is kept as long as they live, so a film of one Scene under many
    cameras is cheap. Memory is bounded by tracing 65536 rays at a time in each of `threads` threads.
    """

    def __init__(self, threads: int | None = None, most_layers: int = 16) -> None:
        """threads: None takes all cores. most_layers: how many see-through surfaces a ray follows behind each other."""
        if most_layers < 1 or (threads is not None and threads < 1):
            raise InputError(f"expected at least one thread and one layer, got {threads} and {most_layers}")
        self._threads = threads or cores()
        self._most_layers = most_layers
        self._scenes: WeakKeyDictionary[Scene, PreparedScene] = WeakKeyDictionary()
        self._grounds: WeakKeyDictionary[Mesh, PreparedScene] = WeakKeyDictionary()
        self._maps: WeakKeyDictionary[Environment, LightingMaps] = WeakKeyDictionary()

    def render(self, scene: Scene, camera: Camera) -> Layer:
        """The scene as the camera sees it, without lens blur; see SceneRenderer."""
        ready = self._prepared(scene)
        height, width = camera.height_px, camera.width_px
        if ready is None:
            return clear(height, width)
        directions = _directions(camera, camera.pixel_centres_px().reshape(-1, 2))
        centres = self._traced(ready, scene, camera, directions, pixel_share=1.0)
        rgb, alpha, depth_m = centres.rgb.copy(), centres.alpha.copy(), centres.depth_m.copy()

        edges = np.flatnonzero(_edges(ready, camera, directions, centres))
        offsets = sixteen_offsets_px()
        for some in np.array_split(edges, max(1, len(edges) * len(offsets) // (8 * _RAYS_AT_ONCE))):
            corner = np.stack([some % width, some // width], axis=-1)
            fine = _directions(camera, (corner[:, None] + offsets).reshape(-1, 2).astype(np.float64))
            samples = self._traced(ready, scene, camera, fine, pixel_share=0.25)
            rgb[some] = samples.rgb.reshape(-1, len(offsets), 3).mean(1)
            alpha[some] = samples.alpha.reshape(-1, len(offsets)).mean(1)
            nearest_m = samples.depth_m.reshape(-1, len(offsets)).min(1)
            depth_m[some] = np.where(np.isfinite(depth_m[some]), depth_m[some], nearest_m)
        depth_m = np.where(alpha > 0, depth_m, np.inf).astype(np.float32)
        return Layer(rgb.reshape(height, width, 3), alpha.reshape(height, width), depth_m.reshape(height, width))

    def render_shadow_mask(self, scene: Scene, camera: Camera, catcher: Mesh) -> Float32[np.ndarray, "height width"]:
        """(H, W) share of the lights' irradiance on the catcher that the scene lets through, 1 is lit; see SceneRenderer."""
        lights, _ = scene.lighting
        ready, ground = self._prepared(scene), self._ground(catcher)
        height, width, eye_m = camera.height_px, camera.width_px, camera.world_from_camera[:3, 3]
        if ready is None or not lights:
            return np.ones((height, width), np.float32)

        def lit_share(xy_px: Float[np.ndarray, "points 2"]) -> Float32[np.ndarray, " points"]:
            directions = _directions(camera, xy_px)
            return np.concatenate(self._in_threads(lambda part: ready.lit_share(ground, lights, eye_m, part), directions))

        mask = lit_share(camera.pixel_centres_px().reshape(-1, 2))
        edges = np.flatnonzero(_steps(mask.reshape(height, width)))
        if len(edges):
            offsets = sixteen_offsets_px()
            corner = np.stack([edges % width, edges // width], axis=-1)
            mask[edges] = lit_share((corner[:, None] + offsets).reshape(-1, 2).astype(np.float64)).reshape(-1, len(offsets)).mean(1)
        return mask.reshape(height, width)

    def _prepared(self, scene: Scene) -> PreparedScene | None:
        """What depends on the scene only; None where it has nothing to draw."""
        if scene not in self._scenes:
            drawn = [mesh for mesh in scene.meshes if len(mesh.triangles) and not mesh.catches_shadow]
            if not drawn:
                return None
            self._scenes[scene] = prepared(drawn)
        return self._scenes[scene]

    def _ground(self, catcher: Mesh) -> PreparedScene:
        """A catcher by itself, receiving light from the side that is seen."""
        if catcher not in self._grounds:
            self._grounds[catcher] = prepared([replace(catcher, material=Material(double_sided=True))])
        return self._grounds[catcher]

    def _lighting(self, scene: Scene) -> tuple[tuple[Light, ...], LightingMaps | None]:
        lights, environment = scene.lighting
        if environment is None:
            return lights, None
        if environment not in self._maps:
            self._maps[environment] = lighting_maps(environment)
        return lights, self._maps[environment]

    def _traced(
        self, ready: PreparedScene, scene: Scene, camera: Camera, directions: Float[np.ndarray, "rays 3"], pixel_share: float
    ) -> RaySamples:
        """Rays from the camera, shaded. pixel_share: the width of what a ray stands for, in pixels."""
        lights, maps = self._lighting(scene)
        footprint = pixel_share / float(np.sqrt(camera.focal_px[0] * camera.focal_px[1]))
        eye_m = camera.world_from_camera[:3, 3]
        return RaySamples.joined(
            self._in_threads(lambda part: ready.shaded(eye_m, part, footprint, lights, maps, self._most_layers), directions)
        )

    def _in_threads(self, work: Callable[[Float[np.ndarray, "some 3"]], _Result], directions: Float[np.ndarray, "rays 3"]) -> list[_Result]:
        """Embree's binding holds Python's lock, the compiled shading does not: so one part is traced while others are shaded."""
        parts = np.array_split(directions, max(1, -(-len(directions) // _RAYS_AT_ONCE)))
        if self._threads == 1 or len(parts) == 1:
            return [work(part) for part in parts]
        with ThreadPoolExecutor(self._threads) as pool:
            return list(pool.map(work, parts))


def _directions(camera: Camera, xy_px: Float[np.ndarray, "points 2"]) -> Float64[np.ndarray, "points 3"]:
    """Rays through points of the picture in world space, 1 long along the optical axis."""
    right, down, forward = camera.world_from_camera[:3, :3].T
    x, y = ((xy_px - np.asarray(camera.principal_px)) / np.asarray(camera.focal_px)).T
    return np.stack([x * right[axis] + y * down[axis] + forward[axis] for axis in range(3)], axis=-1)


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
    padded = np.pad(mask, 1, mode="edge")
    height, width = mask.shape
    neighbours = [padded[row : row + height, column : column + width] for row in range(3) for column in range(3)]
    return np.ptp(np.stack(neighbours), axis=0) > 0.02
