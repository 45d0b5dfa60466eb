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

import numpy as np
from jaxtyping import Float, Float32, Float64

from mrbokeh.optics.camera import Camera
from mrbokeh.scene._lighting_numba import add_environment
from mrbokeh.scene._surface_numba import Surfaces, empty_surfaces, fill_surfaces
from mrbokeh.scene.changed_light import LEAST_CHANGE, LightChange, changed, seen_surface
from mrbokeh.scene.embree.embree_raycaster import EmbreeRaycaster
from mrbokeh.scene.embree.prepared_scenes import prepared
from mrbokeh.scene.embree.shading import visible
from mrbokeh.scene.environment_filter import lighting_maps, reflected_share_table
from mrbokeh.scene.light import Environment, Light
from mrbokeh.scene.material import Material, matte
from mrbokeh.scene.mesh import Mesh, unit
from mrbokeh.scene.mitsuba.mitsuba_tracer import MitsubaTracer
from mrbokeh.scene.virtual_scene import Scene, SceneRenderer
from mrbokeh.system.resources import cores

_RAYS_AT_ONCE = 1 << 18
_WIDEST_CONE_COSINE = 0.5
"""Wider cones around the objects are given up for the whole sky above the surface."""
_NO_EFFECT = LEAST_CHANGE / 8

__all__ = ["GREY", "LEAST_CHANGE", "LightChange", "light_change"]
GREY = matte(0.5, 0.5, 0.5)


def light_change(
    renderer: SceneRenderer, scene: Scene, camera: Camera, catcher: Mesh, surface: Material = GREY, samples: int = 64
) -> LightChange:
    """Return the change that a scene's objects make on a real surface lit by the scene's lights and environment.

    catcher: shape of the surface (also one that catches shadows). surface: its approximate material; only light that comes from the
    objects depends on its albedo. A MitsubaTracer counts everything: shadows of lights and of the environment, mirror images, colour
    bleeding, emissive objects; it uses its own number of samples. With any other renderer the surface is matte and only light that is
    taken away counts: the renderer's shadow mask, and the hidden part of the environment; samples: its rays per pixel towards the
    environment where objects may hide it.
    """
    if isinstance(renderer, MitsubaTracer):
        from mrbokeh.scene.mitsuba.traced_light_change import traced_light_change

        return traced_light_change(renderer, scene, camera, catcher, surface)
    seen = seen_surface(EmbreeRaycaster(), camera, catcher)
    surfaces, centre_m, pixels = _met_surfaces(camera, catcher)
    nothing = np.zeros((len(pixels), 3), np.float32)
    drawn = scene.drawn_meshes
    if not drawn or not len(pixels):
        return changed(seen, pixels, (nothing, nothing, nothing))
    lights, environment = scene.lighting
    total, taken = nothing.copy(), nothing.copy()
    if lights:
        shadow = 1.0 - renderer.render_shadow_mask(scene, camera, catcher).reshape(-1)[pixels]
        total += _direct_light(lights, surfaces, centre_m)
        taken += total * shadow[:, None]
    if environment is not None:
        maps = lighting_maps(environment)
        table = reflected_share_table()
        add_environment(surfaces, maps.peaks, maps.irradiance, maps.reflections, table, maps.environment_from_world, total)
        taken += _hidden_sky(_Objects(drawn), environment, surfaces, centre_m, samples)
    return changed(seen, pixels, (total, taken, nothing))


def _met_surfaces(camera: Camera, catcher: Mesh) -> tuple[Surfaces, Float64[np.ndarray, "3"], np.ndarray]:
    """Return (white surfaces at the pixel centres that see the catcher, the point that they are relative to, those pixels)."""
    white = replace(catcher, material=replace(matte(1.0, 1.0, 1.0), double_sided=True))
    ground = prepared([white])
    eye_m = camera.world_from_camera[:3, 3]
    ones = np.ones((camera.height_px, camera.width_px))
    directions = (camera.unproject(camera.pixel_centres_px(), ones) - eye_m).reshape(-1, 3)
    eye = eye_m - ground.centre_m
    origins = np.broadcast_to(eye.astype(np.float32), directions.shape)
    hits = ground.all_rays.run(np.ascontiguousarray(origins), directions.astype(np.float32), query="INTERSECT")
    pixels = np.flatnonzero(hits >= 0)
    surfaces = empty_surfaces(len(pixels))
    fill_surfaces(ground.triangles, ground.materials, ground.textures, eye[None], directions[pixels], hits[pixels], 0.0, False, surfaces)
    return surfaces, ground.centre_m, pixels


def _direct_light(lights: Sequence[Light], surfaces: Surfaces, centre_m: Float64[np.ndarray, "3"]) -> Float32[np.ndarray, "points 3"]:
    """Return the radiance of a white surface under the lights alone."""
    rgb = np.zeros((len(surfaces.alpha), 3))
    for light in lights:
        towards, _distance_m, irradiance = light.arriving_at(surfaces.shadow_origin + centre_m)
        rgb += np.maximum((surfaces.normal * towards).sum(-1, keepdims=True), 0.0) * irradiance / np.pi
    return rgb.astype(np.float32)


class _Objects:
    """Objects that hide the sky, and the ball around them."""

    def __init__(self, drawn: Sequence[Mesh]) -> None:
        self._rays = prepared(drawn)
        points_m = self._rays.triangles.corners_m.reshape(-1, 3)
        middle_m = (points_m.min(0) + points_m.max(0)) / 2
        self.radius_m = float(np.linalg.norm(points_m - middle_m, axis=1).max())
        self.middle_m = middle_m + self._rays.centre_m

    def hidden(self, points_m: Float[np.ndarray, "points 3"], towards: Float[np.ndarray, "points 3"]) -> Float32[np.ndarray, " points"]:
        """Return the share of light from infinitely far that the objects keep from points."""
        far_m = np.full(len(points_m), np.inf)
        return 1.0 - visible(self._rays, points_m - self._rays.centre_m, towards, far_m)


def _hidden_sky(
    objects: _Objects, environment: Environment, surfaces: Surfaces, centre_m: Float64[np.ndarray, "3"], samples: int
) -> Float32[np.ndarray, "points 3"]:
    """Radiance that white surfaces lose as objects stand before the environment."""
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
        useful = weight > 0
        origins_m = np.broadcast_to(points_m[some][:, None], towards.shape)[useful]
        light = weight[useful][:, None] * _radiance(environment, towards[useful]) * objects.hidden(origins_m, towards[useful])[:, None]
        for channel in range(3):
            lost[some, channel] = np.bincount(np.nonzero(useful)[0], light[:, channel], len(some)) / uv.shape[1]

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
