"""Change of light on a real surface by virtual objects: shadow, reflection and the light that they send there.

Differential rendering (Debevec 1998, "Rendering Synthetic Objects into Real Scenes"), with the two directions of change apart: light
that objects take away is a share of the light before, so it multiplies the photograph; light that they send is added. So the surface's
texture comes from the photograph alone, and a rough guess of its material suffices.

Without Mitsuba the ray caster computes shadows of lights and the part of the environment that objects hide; the surface is matte,
nothing is added. The environment is sampled evenly, so a small sun in a panorama has to be split off first (`split_sun`), which the ray
caster needs anyway.
"""

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from weakref import WeakKeyDictionary

import numpy as np
from jaxtyping import Float, Float32, Float64, Int64

from mrbokeh.optics.camera import Camera
from mrbokeh.scene._lighting_numba import add_environment
from mrbokeh.scene._surface_numba import Surfaces, empty_surfaces, fill_surfaces
from mrbokeh.scene.changed_light import LEAST_CHANGE, LightChange, changed, seen_surface
from mrbokeh.scene.embree.embree_raycaster import EmbreeRaycaster
from mrbokeh.scene.embree.prepared_scenes import prepared
from mrbokeh.scene.embree.shading import visible
from mrbokeh.scene.environment_filter import lighting_maps, reflected_share_table
from mrbokeh.scene.light import Environment
from mrbokeh.scene.material import Material, matte
from mrbokeh.scene.mesh import Mesh, unit
from mrbokeh.scene.mitsuba.mitsuba_tracer import MitsubaTracer
from mrbokeh.scene.virtual_scene import Scene, SceneRenderer
from mrbokeh.system.resources import cores

_RAYS_AT_ONCE = 1 << 18
_WIDEST_CONE_COSINE = 0.5
"""Wider cones around the objects are given up for the whole sky above the surface."""
_NO_EFFECT = LEAST_CHANGE / 8

__all__ = ["GREY", "LEAST_CHANGE", "LightChange", "light_change", "light_left"]
GREY = matte(0.5, 0.5, 0.5)


def light_change(
    renderer: SceneRenderer, scene: Scene, camera: Camera, catcher: Mesh, surface: Material = GREY, samples: int = 64
) -> LightChange:
    """Return the change that a scene's objects make on a real surface lit by the scene's lights and environment.

    catcher: shape of the surface (also one that catches shadows). surface: its approximate material; only light that comes from the
    objects depends on its albedo. A MitsubaTracer counts everything: shadows of lights and of the environment, mirror images, colour
    bleeding, emissive objects; it uses its own number of samples. With any other renderer the surface is matte and only light that is
    taken away counts: by a ray from the middle of a pixel towards each light, and by so many samples of the environment where objects
    may hide it.
    """
    if isinstance(renderer, MitsubaTracer):
        from mrbokeh.scene.mitsuba.traced_light_change import traced_light_change

        return traced_light_change(renderer, scene, camera, catcher, surface)
    seen = seen_surface(EmbreeRaycaster(), camera, catcher)
    surfaces, centre_m, pixels = _met_surfaces(camera, catcher, np.arange(seen.alpha.size))
    if not scene.drawn_meshes or not len(pixels):
        nothing = np.zeros((len(pixels), 3), np.float32)
        return changed(seen, pixels, (nothing, nothing, nothing))
    total, taken = _lost(scene, surfaces, centre_m, samples)
    return changed(seen, pixels, (total, taken, np.zeros_like(taken)))


def light_left(
    scene: Scene, camera: Camera, catcher: Mesh, pixels: Int64[np.ndarray, " pixels"], samples: int = 64
) -> Float32[np.ndarray, "pixels 3"]:
    """Return the share of light that remains on a matte surface in the middle of some pixels (row after row), 1 beside the surface.

    It is what `light_change` computes without Mitsuba.
    """
    ratio = np.ones((len(pixels), 3), np.float32)
    surfaces, centre_m, met = _met_surfaces(camera, catcher, pixels)
    if scene.drawn_meshes and len(met):
        total, taken = _lost(scene, surfaces, centre_m, samples)
        ratio[met] -= np.clip(taken / np.maximum(total, 1e-12), 0.0, 1.0)
    return ratio


def _lost(
    scene: Scene, surfaces: Surfaces, centre_m: Float64[np.ndarray, "3"], samples: int
) -> tuple[Float32[np.ndarray, "points 3"], Float32[np.ndarray, "points 3"]]:
    """Return the radiance of white surfaces before objects came, and what these take of it."""
    lights, environment = scene.lighting
    objects, apart = _objects_of(scene)
    total, taken = (np.zeros((len(surfaces.alpha), 3), np.float32) for _ in range(2))
    for light in lights:
        towards, distance_m, irradiance = light.arriving_at(surfaces.shadow_origin + centre_m)
        arriving = np.maximum((surfaces.normal * towards).sum(-1, keepdims=True), 0.0) * irradiance / np.pi
        total += arriving
        if light.casts_shadow:
            taken += arriving * objects.hidden(surfaces.shadow_origin + centre_m, towards, distance_m)[:, None]
    if environment is not None:
        maps = lighting_maps(environment)
        table = reflected_share_table()
        add_environment(surfaces, maps.peaks, maps.irradiance, maps.reflections, table, maps.environment_from_world, total)
        for number, each in enumerate(apart):
            taken += _hidden_sky(each, apart[:number], environment, surfaces, centre_m, samples)
    return total, taken


def _met_surfaces(
    camera: Camera, catcher: Mesh, pixels: Int64[np.ndarray, " pixels"]
) -> tuple[Surfaces, Float64[np.ndarray, "3"], Int64[np.ndarray, " met"]]:
    """Return (white surfaces at the centres of pixels that see the catcher, the point that they are relative to, which of the pixels)."""
    white = replace(catcher, material=replace(matte(1.0, 1.0, 1.0), double_sided=True))
    ground = prepared([white])
    eye_m = camera.world_from_camera[:3, 3]
    centres_px = np.stack([pixels % camera.width_px, pixels // camera.width_px], axis=-1) + 0.5
    directions = camera.unproject(centres_px, np.ones(len(pixels))) - eye_m
    eye = eye_m - ground.centre_m
    origins = np.broadcast_to(eye.astype(np.float32), directions.shape)
    hits = ground.all_rays.run(np.ascontiguousarray(origins), directions.astype(np.float32), query="INTERSECT")
    met = np.flatnonzero(hits >= 0)
    surfaces = empty_surfaces(len(met))
    fill_surfaces(ground.triangles, ground.materials, ground.textures, eye[None], directions[met], hits[met], 0.0, False, surfaces)
    return surfaces, ground.centre_m, met


class _Objects:
    """Objects that hide the sky, and the ball around them."""

    def __init__(self, drawn: Sequence[Mesh]) -> None:
        self._rays = prepared(drawn)
        points_m = self._rays.triangles.corners_m.reshape(-1, 3)
        middle_m = (points_m.min(0) + points_m.max(0)) / 2
        self.radius_m = float(np.linalg.norm(points_m - middle_m, axis=1).max())
        self.middle_m = middle_m + self._rays.centre_m

    def hidden(
        self,
        points_m: Float[np.ndarray, "points 3"],
        towards: Float[np.ndarray, "points 3"],
        distance_m: Float[np.ndarray, " points"],
    ) -> Float32[np.ndarray, " points"]:
        """Return the share of light, from so far away, that the objects keep from points."""
        return 1.0 - visible(self._rays, points_m - self._rays.centre_m, towards, distance_m)


_KEPT = WeakKeyDictionary[Scene, tuple[_Objects, list[_Objects]]]()


def _objects_of(scene: Scene) -> tuple[_Objects, list[_Objects]]:
    """Return all of a scene, and each of its objects; kept as long as the scene: light on one ground is asked for some ten times."""
    if scene not in _KEPT:
        objects = _Objects(scene.drawn_meshes)
        apart = [_Objects(each.drawn_meshes) for each in scene.parts if each.drawn_meshes] if len(scene.parts) > 1 else [objects]
        _KEPT[scene] = objects, apart
    return _KEPT[scene]


def _hidden_sky(
    objects: _Objects,
    others: Sequence[_Objects],
    environment: Environment,
    surfaces: Surfaces,
    centre_m: Float64[np.ndarray, "3"],
    samples: int,
) -> Float32[np.ndarray, "points 3"]:
    """Radiance that white surfaces lose as objects, but no others, stand before the environment."""
    lost = np.zeros((len(surfaces.alpha), 3), np.float32)
    points_m = surfaces.shadow_origin + centre_m
    sine2 = (objects.radius_m / np.maximum(np.linalg.norm(objects.middle_m - points_m, axis=1), 1e-12)) ** 2
    near = np.flatnonzero(sine2 > _NO_EFFECT)
    rng, at_once = np.random.default_rng(0), max(1, _RAYS_AT_ONCE // samples)
    # The golden lattice is as even as Sobol points, which SciPy takes a second to load.
    grid = np.stack([(np.arange(samples) + 0.5) / samples, np.arange(samples) * (5**0.5 - 1) / 2 % 1.0], axis=-1)

    def lose(some: np.ndarray, shift: np.ndarray) -> None:
        uv = (grid + shift) % 1.0
        normals = surfaces.normal[some].astype(np.float64)
        towards, weight = _drawn(objects, points_m[some], normals, sine2[some], uv)
        weight *= np.maximum(np.einsum("psk,pk->ps", towards, normals), 0.0) / np.pi
        point, sample = np.nonzero(weight > 0)
        hidden = objects.hidden(points_m[some[point]], towards[point, sample], np.full(len(point), np.inf))
        for each in others:
            hidden *= 1.0 - each.hidden(points_m[some[point]], towards[point, sample], np.full(len(point), np.inf))
        met = np.flatnonzero(hidden)
        point, sample = point[met], sample[met]
        light = (weight[point, sample] * hidden[met])[:, None] * _radiance(environment, towards[point, sample])
        for channel in range(3):
            lost[some, channel] = np.bincount(point, light[:, channel], len(some)) / uv.shape[1]

    parts = [near[start : start + at_once] for start in range(0, len(near), at_once)]
    shifts = [rng.random((len(some), 1, 2)) for some in parts]
    with ThreadPoolExecutor(cores()) as pool:
        list(pool.map(lose, parts, shifts))
    return lost


def _drawn(
    objects: _Objects,
    points_m: Float[np.ndarray, "points 3"],
    normals: Float[np.ndarray, "points 3"],
    sine2: Float[np.ndarray, " points"],
    uv: Float[np.ndarray, "points samples 2"],
) -> tuple[Float[np.ndarray, "points samples 3"], Float[np.ndarray, "points samples"]]:
    """Return (directions, 1 / density), drawn in the cone around the objects, or by the cosine if that cone is wide."""
    narrow = sine2 < 1.0 - _WIDEST_CONE_COSINE**2
    off = np.where(narrow, sine2 / (1.0 + np.sqrt(np.maximum(1.0 - sine2, 0.0))), 1.0)[:, None] * uv[..., 0]
    rising = np.where(narrow[:, None], 1.0 - off, np.sqrt(1.0 - uv[..., 0]))
    level = np.where(narrow[:, None], np.sqrt(off * (2.0 - off)), np.sqrt(uv[..., 0]))
    axis = np.where(narrow[:, None], unit(objects.middle_m - points_m), normals)
    sideways = unit(np.cross(axis, np.where(np.abs(axis[:, :1]) < 0.5, [[1.0, 0.0, 0.0]], [[0.0, 1.0, 0.0]])))
    across, turn = np.cross(axis, sideways), 2 * np.pi * uv[..., 1]
    towards = level[..., None] * (np.cos(turn)[..., None] * sideways[:, None] + np.sin(turn)[..., None] * across[:, None])
    versine = sine2 / (1.0 + np.sqrt(np.maximum(1.0 - sine2, 0.0)))
    weight = np.where(narrow[:, None], 2 * np.pi * versine[:, None], np.pi / np.maximum(rising, 1e-6))
    return towards + rising[..., None] * axis[:, None], weight


def _radiance(environment: Environment, towards: Float[np.ndarray, "rays 3"]) -> Float32[np.ndarray, "rays 3"]:
    """The panorama's nearest pixel in directions of the world."""
    x, y, z = (towards @ environment.world_from_environment).T
    height, width = environment.radiance.shape[:2]
    column = ((np.arctan2(x, z) / (2 * np.pi) + 0.5) * width).astype(int) % width
    row = np.minimum((np.arccos(np.clip(-y, -1.0, 1.0)) / np.pi * height).astype(int), height - 1)
    return environment.radiance[row, column]
