"""Shading of rays through a prepared scene: colour, coverage and depth; the share of the lights that reaches a point."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Float32, Float64, Int32, Int64

from mrbokeh.images.color import luminance
from mrbokeh.scene._lighting_numba import add_emission, add_environment, add_light
from mrbokeh.scene._surface_numba import Surfaces, empty_surfaces, fill_surfaces
from mrbokeh.scene.embree._marking_numba import mark_reachable
from mrbokeh.scene.embree.prepared_scenes import NOTHING_LEFT, STEP, PreparedScene, closest, float32
from mrbokeh.scene.environment_filter import LightingMaps, reflected_share_table
from mrbokeh.scene.light import Light

MOST_LAYERS = 16
"""See-through surfaces that a ray follows behind each other, from the eye and towards a light."""


def visible(
    scene: PreparedScene,
    origins: Float[np.ndarray, "points 3"],
    towards: Float[np.ndarray, "points 3"],
    distance_m: Float[np.ndarray, " points"],
) -> Float32[np.ndarray, " points"]:
    """Return the share of a light's rays that reach the origins: 0 behind opaque surfaces, the product of 1 - alpha behind others."""
    reaching = np.ones(len(origins), np.float32)
    if scene.opaque_rays is not None and len(origins):
        blocked = scene.opaque_rays.run(*float32(origins, towards), np.minimum(distance_m, 1e37).astype(np.float32), query="OCCLUDED")
        reaching[blocked >= 0] = 0.0
    if scene.see_through_rays is None:
        return reaching
    active, start = np.flatnonzero(reaching), np.zeros(np.count_nonzero(reaching))
    for _ in range(MOST_LAYERS):
        rays = towards[active]
        hits = closest(scene.see_through_rays, origins[active] + start[:, None] * rays, rays)
        met = np.flatnonzero(hits >= 0)
        if not len(met):
            break
        active, start, veils = active[met], start[met], scene.see_through[hits[met]]
        surfaces = empty_surfaces(len(active))
        fill_surfaces(scene.triangles, scene.materials, scene.textures, origins[active], rays[met], veils, 0.0, True, surfaces)
        before_light = surfaces.depth < distance_m[active]
        reaching[active] *= np.where(before_light, 1.0 - surfaces.alpha, 1.0)
        start = np.maximum(surfaces.depth, start) + 2 * STEP * scene.reach_m
        goes_on = before_light & (reaching[active] > NOTHING_LEFT)
        active, start = active[goes_on], start[goes_on]
    return reaching


def lit_share(
    scene: PreparedScene,
    ground: PreparedScene,
    lights: Sequence[Light],
    world_from_self: Float[np.ndarray, "4 4"],
    eye_m: Float[np.ndarray, "3"],
    directions: Float[np.ndarray, "rays 3"],
) -> Float32[np.ndarray, " rays"]:
    """Share of the lights' irradiance that reaches the ground where rays from the eye meet it; 1 where they do not.

    Ground, lights, eye and rays are in world axes.
    """
    eye, share = eye_m - ground.centre_m, np.ones(len(directions), np.float32)
    hits = closest(ground.all_rays, np.broadcast_to(eye, directions.shape), directions)
    some = _in_reach(scene, ground, lights, world_from_self, eye, directions, hits)
    if not len(some):
        return share
    surfaces = ground.surfaces(eye, np.ascontiguousarray(directions[some]), hits[some], 0.0)
    points_m, turn = surfaces.shadow_origin + ground.centre_m, world_from_self[:3, :3]
    arriving, unobstructed = np.zeros(len(some)), np.zeros(len(some))
    for light in lights:
        towards, distance_m, irradiance = light.arriving_at(points_m)
        cosine = np.maximum(np.einsum("rk,rk->r", surfaces.normal, towards), 0.0)
        amount = cosine * luminance(np.asarray(irradiance, np.float64)) * surfaces.alpha
        lit = np.flatnonzero(amount > 0)
        unobstructed[lit] += amount[lit]
        own_m = (points_m[lit] - world_from_self[:3, 3]) @ turn - scene.centre_m
        reaching = visible(scene, own_m, towards[lit] @ turn, distance_m[lit]) if light.casts_shadow else 1.0
        arriving[lit] += amount[lit] * reaching
    share[some] = np.where(unobstructed > 0, arriving / np.maximum(unobstructed, 1e-30), 1.0)
    return share


def _in_reach(
    scene: PreparedScene,
    ground: PreparedScene,
    lights: Sequence[Light],
    world_from_self: Float[np.ndarray, "4 4"],
    eye: Float[np.ndarray, "3"],
    directions: Float[np.ndarray, "rays 3"],
    hits: Int32[np.ndarray, " rays"],
) -> Int64[np.ndarray, " some"]:
    """Rays that meet the ground where the box around this scene can stand between it and a light.

    On a curved ground shadow rays do not start where the triangles are: all of it counts as in reach.
    """
    if not ground.is_flat:
        return np.flatnonzero(hits >= 0)
    own_from_ground = world_from_self[:3, :3].T
    shift = own_from_ground @ (ground.centre_m - world_from_self[:3, 3]) - scene.centre_m
    sources = [light for light in lights if light.casts_shadow]
    at_infinity = np.array([light.kind == "directional" for light in sources], np.bool_)
    places = [
        own_from_ground @ (-np.asarray(light.direction) if far else np.asarray(light.position_m) - world_from_self[:3, 3])
        - (0.0 if far else scene.centre_m)
        for light, far in zip(sources, at_infinity, strict=True)
    ]
    reached = np.zeros(len(hits), np.bool_)
    mark_reachable(
        ground.triangles.corners_m,
        hits,
        eye,
        np.ascontiguousarray(directions),
        np.ascontiguousarray(own_from_ground),
        shift,
        np.array(places).reshape(-1, 3),
        at_infinity,
        scene.half_size_m + 1e-3 * scene.reach_m,
        reached,
    )
    return np.flatnonzero(reached)


@dataclass(frozen=True, eq=False)
class RaySamples:
    """Colour, coverage and depth along N rays.

    rgb is premultiplied; mesh, normal and lit (mean share of the lights that is not in shadow, 1 if there are none) belong to the first
    surface that covers anything.
    """

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
) -> RaySamples:
    """Follow rays front to back through see-through and cut-out surfaces; directions are 1 long along the optical axis."""
    count, eye = len(directions), eye_m - scene.centre_m
    rgb, shines_through = np.zeros((count, 3), np.float32), np.ones(count, np.float32)
    lit = np.ones(count, np.float32)
    depth_m, mesh, normal = np.full(count, np.inf), np.full(count, -1, np.int32), np.zeros((count, 3), np.float32)
    active, start = np.arange(count), np.zeros(count)
    for _ in range(MOST_LAYERS):
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
    return RaySamples(rgb=rgb, alpha=alpha, depth_m=depth_m, mesh=mesh, normal=normal, lit=lit)


def _radiance(
    scene: PreparedScene, surfaces: Surfaces, lights: Sequence[Light], maps: LightingMaps | None
) -> tuple[Float32[np.ndarray, "rays 3"], Float32[np.ndarray, " rays"]]:
    """Return (light that leaves the shading points towards the camera, mean share of the lights that is not in shadow)."""
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
