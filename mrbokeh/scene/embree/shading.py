"""Rays through a prepared scene: colour, coverage and depth of what they meet."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Float32, Float64, Int32

from mrbokeh.scene._lighting_numba import add_emission, add_environment, add_light
from mrbokeh.scene._surface_numba import Surfaces
from mrbokeh.scene.embree.packed_triangles import NOTHING_LEFT, STEP, PreparedScene, closest
from mrbokeh.scene.embree.shadows import visible
from mrbokeh.scene.environment_filter import LightingMaps, reflected_share_table
from mrbokeh.scene.light import Light


@dataclass(frozen=True, eq=False)
class RaySamples:
    """What N rays see. rgb is premultiplied; mesh, normal and lit (the mean share of the lights that is not in shadow, 1 where
    there are none) belong to the first surface that covers anything."""

    rgb: Float32[np.ndarray, "rays 3"]
    alpha: Float32[np.ndarray, " rays"]
    depth_m: Float64[np.ndarray, " rays"]
    mesh: Int32[np.ndarray, " rays"]
    normal: Float32[np.ndarray, "rays 3"]
    lit: Float32[np.ndarray, " rays"]

    @staticmethod
    def joined(parts: Sequence["RaySamples"]) -> "RaySamples":
        names = ("rgb", "alpha", "depth_m", "mesh", "normal", "lit")
        return RaySamples(*(np.concatenate([getattr(part, name) for part in parts]) for name in names))


def shaded(
    scene: PreparedScene,
    eye_m: Float[np.ndarray, "3"],
    directions: Float[np.ndarray, "rays 3"],
    footprint: float,
    lights: Sequence[Light],
    maps: LightingMaps | None,
    most_layers: int,
) -> RaySamples:
    """Follow rays front to back through see-through and cut-out surfaces; directions are 1 long along the optical axis."""
    count, eye = len(directions), eye_m - scene.centre_m
    rgb, shines_through = np.zeros((count, 3), np.float32), np.ones(count, np.float32)
    lit = np.ones(count, np.float32)
    depth_m, mesh, normal = np.full(count, np.inf), np.full(count, -1, np.int32), np.zeros((count, 3), np.float32)
    active, start = np.arange(count), np.zeros(count)
    for _ in range(most_layers):
        rays = directions[active]
        hits = closest(scene.all_rays, eye + start[:, None] * rays, rays)
        met = np.flatnonzero(hits >= 0)
        if not len(met):
            break
        active, start, hits = active[met], start[met], hits[met]
        surfaces = scene.surfaces(eye, rays[met], hits, footprint)
        light, not_shadowed = _radiance(scene, surfaces, lights, maps)
        covers = surfaces.alpha * shines_through[active]
        rgb[active] += covers[:, None] * light
        seen = surfaces.alpha > 0
        # The depth of what one mostly sees: the surface at which half of the view is covered, or else the first.
        decides = seen & ((mesh[active] < 0) | (shines_through[active] > 0.5))
        depth_m[active[decides]] = surfaces.depth[decides]
        first = np.flatnonzero(seen & (mesh[active] < 0))
        normal[active[first]], mesh[active[first]] = surfaces.face_normal[first], surfaces.mesh[first]
        lit[active[first]] = not_shadowed[first]
        shines_through[active] -= covers
        goes_on = shines_through[active] > NOTHING_LEFT
        length = np.sqrt(np.einsum("rk,rk->r", directions[active], directions[active]))
        start = np.maximum(surfaces.depth, start) + STEP * (scene.reach_m + np.abs(eye).max()) / length
        active, start = active[goes_on], start[goes_on]
    alpha = np.where(shines_through <= NOTHING_LEFT, 1.0, 1.0 - shines_through).astype(np.float32)
    return RaySamples(rgb, alpha, depth_m, mesh, normal, lit)


def _radiance(
    scene: PreparedScene, surfaces: Surfaces, lights: Sequence[Light], maps: LightingMaps | None
) -> tuple[Float32[np.ndarray, "rays 3"], Float32[np.ndarray, " rays"]]:
    """(light that leaves the shading points towards the camera, mean share of the lights that is not in shadow)."""
    rgb = np.zeros((len(surfaces.alpha), 3), np.float32)
    not_shadowed = np.ones(len(surfaces.alpha), np.float32)
    add_emission(surfaces, rgb)
    if maps is not None:
        table = reflected_share_table()
        add_environment(surfaces, maps.peaks, maps.irradiance, maps.reflections, table, maps.environment_from_world, rgb)
    for light in lights:
        towards, distance_m, irradiance = light.arriving_at(surfaces.shadow_origin + scene.centre_m)
        arriving = np.array(irradiance, np.float32)
        if light.casts_shadow:
            facing = np.einsum("rk,rk->r", surfaces.normal, towards) > 0
            lit = np.flatnonzero(facing & (surfaces.alpha > 0) & (surfaces.roughness >= 0) & (arriving @ np.ones(3, np.float32) > 0))
            origins = surfaces.shadow_origin[lit] + 2 * STEP * scene.reach_m * surfaces.face_normal[lit]
            reaching = visible(scene, origins, towards[lit], distance_m[lit])
            arriving[lit] *= reaching[:, None]
            not_shadowed[lit] -= (1.0 - reaching) / len(lights)
        add_light(surfaces, np.ascontiguousarray(towards), arriving, rgb)
    return rgb, not_shadowed
