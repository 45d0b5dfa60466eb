"""Path tracing with multiple importance sampling (Veach 1997; Pharr, Jakob and Humphreys 2023, section 13.4), by Mitsuba's compiler."""

from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi

from mrbokeh.scene.mitsuba_reflection import Reflection, luminance, reflection
from mrbokeh.scene.mitsuba_world import World

_SURE_BOUNCES = 3
"""From there on faint paths are ended by chance."""

_NOTHING = 0xFFFFFFFF


@dataclass(frozen=True)
class Rays:
    """Where paths start. density: of their directions per steradian where shining triangles are drawn for besides, else 0.

    from_camera: surfaces that are invisible from behind let them pass, and the environment does not count.
    width_per_m: what a ray stands for is so wide at one metre.
    """

    origin: Any
    direction: Any
    active: Any
    from_camera: bool
    density: Any = 0.0
    width_per_m: Any = 0.0


@dataclass(frozen=True)
class Seen:
    """What came along the rays. stands: whether there was a surface; first: number of its triangle; albedo, normal: of it."""

    radiance: Any
    stands: Any
    first: Any
    albedo: Any
    normal: Any


def followed(world: World, rays: Rays, sampler: Any, most_bounces: int) -> Seen:
    """Radiance along rays. most_bounces: how many surfaces light may meet on its way; 1 is direct light only."""
    count = dr.width(rays.active)
    most = dr.opaque(mi.UInt32, most_bounces)

    def step(
        origin: Any, ray: Any, active: Any, bounce: Any, carried: Any, radiance: Any, density: Any, passed: Any, first: Any, *rest: Any
    ) -> tuple[Any, ...]:
        albedo, normal, sampler = rest
        hit = world.met(mi.Ray3f(origin, ray), active)
        met, at_start = active & hit.is_valid(), bounce == 0
        if world.environment is not None:
            free = active & ~met & (mi.Bool(not rays.from_camera) | ~at_start)
            weight = dr.select(at_start, 1.0, _share(density, world.environment.density(ray, free)))
            radiance = dr.select(free, radiance + carried * world.environment.radiance(ray, free) * weight, radiance)

        width = dr.select(at_start, passed + hit.t, 0.0) * rays.width_per_m
        point = world.surfaces.point(hit, ray, width, met)
        through = sampler.next_1d(met) >= point.alpha
        if rays.from_camera:
            through |= at_start & ~point.seen
        through &= met
        stands = met & ~through
        surface = world.surfaces.surface(point, ray, stands)
        first = dr.select(stands & at_start, point.triangle, first)
        albedo = dr.select(stands & at_start, dr.select(point.unlit, point.base, surface.diffuse + surface.f0), albedo)
        normal = dr.select(stands & at_start, surface.normal, normal)

        # What shines by itself.
        weight = mi.Float(1.0)
        if world.shining.any:
            weight = _share(density, world.shining.density(point.triangle, passed + hit.t, dr.dot(point.face, ray), stands))
            weight = dr.select(density > 0.0, weight, 1.0)
        glow = dr.select(point.unlit, point.base, surface.emissive * weight)
        radiance = dr.select(stands & point.seen, radiance + carried * glow, radiance)

        # What it reflects of the lamps, and where the path goes on.
        reflects_on = stands & point.seen & ~point.unlit & (bounce < most)
        reflects = reflection(surface, world.shares)
        light = world.lamps(reflects, reflects_on) + drawn_lights(world, reflects, sampler, reflects_on)
        radiance = dr.select(reflects_on, radiance + carried * light, radiance)
        onward = reflects.drawn(sampler.next_1d(reflects_on), sampler.next_2d(reflects_on))
        value, onward_density = reflects.value(onward)
        carried = dr.select(reflects_on, carried * value / dr.maximum(onward_density, 1e-20), carried)
        goes_on = reflects_on & (onward_density > 0.0) & (dr.max(carried) > 0.0) & (dr.dot(surface.smooth, onward) > 0.0)
        survival = dr.select(bounce >= _SURE_BOUNCES, dr.clip(dr.max(carried), 0.05, 0.95), 1.0)
        goes_on &= sampler.next_1d(reflects_on) < survival
        carried = dr.select(goes_on, carried / survival, carried)

        origin = dr.select(through, world.past(point, ray), dr.select(goes_on, surface.origin, origin))
        passed = dr.select(through, passed + hit.t, 0.0)
        density = dr.select(goes_on, onward_density, density)
        ray = dr.select(goes_on, onward, ray)
        bounce = dr.select(goes_on, bounce + 1, bounce)
        return origin, ray, through | goes_on, bounce, carried, radiance, density, passed, first, albedo, normal, sampler

    state = (
        mi.Point3f(rays.origin),
        mi.Vector3f(rays.direction),
        mi.Bool(rays.active),
        dr.zeros(mi.UInt32, count),
        dr.full(mi.Color3f, 1.0, count),
        dr.zeros(mi.Color3f, count),
        mi.Float(rays.density) + dr.zeros(mi.Float, count),
        dr.zeros(mi.Float, count),
        dr.full(mi.UInt32, _NOTHING, count),
        dr.zeros(mi.Color3f, count),
        dr.zeros(mi.Vector3f, count),
        sampler,
    )
    *_, radiance, _density, _passed, first, albedo, normal, _sampler = dr.while_loop(state, lambda *each: each[2], step)
    finite = dr.isfinite(radiance.x + radiance.y + radiance.z)
    return Seen(dr.select(finite, radiance, 0.0), first != _NOTHING, first, albedo, normal)


def drawn_lights(world: World, reflects: Reflection, sampler: Any, active: Any) -> Any:
    """Radiance reflected from one point drawn of the environment and one of the shining triangles."""
    result = mi.Color3f(0.0)
    if world.environment is not None:
        result += environment_light(world, reflects, sampler, active)
    if world.shining.any:
        value_of = reflects.value
        result += shining_light(world, reflects.surface.origin, value_of, sampler, active)
    return result


def environment_light(world: World, reflects: Reflection, sampler: Any, active: Any) -> Any:
    assert world.environment is not None
    towards, density = world.environment.drawn(sampler.next_2d(active), active)
    value, other_density = reflects.value(towards)
    wanted = active & (dr.max(value) > 0.0) & (density > 0.0)
    arrives = world.open_share(reflects.surface.origin, towards, mi.Float(dr.largest(mi.Float)), wanted)
    weight = _share(density, other_density) / dr.maximum(density, 1e-20)
    return dr.select(wanted, value * world.environment.radiance(towards, wanted) * (arrives * weight), 0.0)


def shining_light(world: World, origin: Any, value_of: Any, sampler: Any, active: Any) -> Any:
    """value_of(direction) -> (BRDF times cosine, density of the other ways in which that direction is drawn)."""
    which, place = world.shining.drawn(sampler.next_1d(active), sampler.next_2d(active), active)
    emitted, towards, distance, density = world.shine(which, place, origin, active)
    value, other_density = value_of(towards)
    wanted = active & (dr.max(value * emitted) > 0.0)
    arrives = world.open_share(origin, towards, distance, wanted)
    weight = _share(density, other_density) / dr.maximum(density, 1e-20)
    return dr.select(wanted, value * emitted * (arrives * weight), 0.0)


def _share(density: Any, other: Any) -> Any:
    """The balance heuristic."""
    return density / dr.maximum(density + other, 1e-20)


__all__ = ["Rays", "Seen", "drawn_lights", "environment_light", "followed", "luminance", "shining_light"]
