"""Path tracing with multiple importance sampling (Veach 1997; Pharr, Jakob and Humphreys 2023, section 13.4), by Mitsuba's compiler."""

from dataclasses import dataclass
from typing import Any, NamedTuple

import drjit as dr
import mitsuba as mi

from mrbokeh.scene.mitsuba.drawn_lights import balance, drawn_lights
from mrbokeh.scene.mitsuba.reflection import Reflection, reflection
from mrbokeh.scene.mitsuba.world import World

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


class _Path(NamedTuple):
    """What paths bring along, of each ray.

    carried: the share of light that gets from here to the start. density: of the direction in which it was drawn. passed: metres from
    where it started through surfaces that let it pass. first, albedo, normal: of the first surface that did not.
    """

    origin: Any
    direction: Any
    active: Any
    bounce: Any
    carried: Any
    radiance: Any
    density: Any
    passed: Any
    first: Any
    albedo: Any
    normal: Any
    sampler: Any

    @property
    def at_start(self) -> Any:
        return self.bounce == 0

    def lit(self, light: Any, where: Any) -> "_Path":
        return self._replace(radiance=dr.select(where, self.radiance + light, self.radiance))


class _Meeting(NamedTuple):
    """What paths come upon: met, and then through (the surface lets them pass) or stands. distance: to it in metres."""

    point: Any
    surface: Any
    distance: Any
    met: Any
    through: Any
    stands: Any


def followed(world: World, rays: Rays, sampler: Any, most_bounces: int) -> Seen:
    """Radiance along rays. most_bounces: how many surfaces light may meet on its way; 1 is direct light only."""
    most = dr.opaque(mi.UInt32, most_bounces)
    start = tuple(_started(rays, sampler))
    ends = dr.while_loop(start, lambda *path: _Path(*path).active, lambda *path: tuple(_stepped(world, rays, most, _Path(*path))))
    path = _Path(*ends)
    finite = dr.isfinite(path.radiance.x + path.radiance.y + path.radiance.z)
    return Seen(dr.select(finite, path.radiance, 0.0), path.first != _NOTHING, path.first, path.albedo, path.normal)


def _started(rays: Rays, sampler: Any) -> _Path:
    count = dr.width(rays.active)
    return _Path(
        origin=mi.Point3f(rays.origin),
        direction=mi.Vector3f(rays.direction),
        active=mi.Bool(rays.active),
        bounce=dr.zeros(mi.UInt32, count),
        carried=dr.full(mi.Color3f, 1.0, count),
        radiance=dr.zeros(mi.Color3f, count),
        density=mi.Float(rays.density) + dr.zeros(mi.Float, count),
        passed=dr.zeros(mi.Float, count),
        first=dr.full(mi.UInt32, _NOTHING, count),
        albedo=dr.zeros(mi.Color3f, count),
        normal=dr.zeros(mi.Vector3f, count),
        sampler=sampler,
    )


def _stepped(world: World, rays: Rays, most: Any, path: _Path) -> _Path:
    """From one surface to the next. most: bounces."""
    meets = _meeting(world, rays, path)
    path = _lit_from_afar(world, rays, path, path.active & ~meets.met)
    path = _glowed_upon(world, _first_noted(path, meets), meets)
    reflects, reflects_on = reflection(meets.surface, world.shares), _reflects_on(path, meets, most)
    light = world.lamps(reflects, reflects_on) + drawn_lights(world, reflects, path.sampler, reflects_on)
    return _gone_on(world, path.lit(path.carried * light, reflects_on), meets, reflects, reflects_on)


def _meeting(world: World, rays: Rays, path: _Path) -> _Meeting:
    hit = world.met(mi.Ray3f(path.origin, path.direction), path.active)
    met = path.active & hit.is_valid()
    width = dr.select(path.at_start, path.passed + hit.t, 0.0) * rays.width_per_m
    point = world.surfaces.point(hit, path.direction, width, met)
    through = path.sampler.next_1d(met) >= point.alpha
    if rays.from_camera:
        through |= path.at_start & ~point.seen
    through &= met
    stands = met & ~through
    return _Meeting(point, world.surfaces.surface(point, path.direction, stands), hit.t, met, through, stands)


def _lit_from_afar(world: World, rays: Rays, path: _Path, missed: Any) -> _Path:
    """By the environment, where nothing was met."""
    if world.environment is None:
        return path
    free = missed & (mi.Bool(not rays.from_camera) | ~path.at_start)
    weight = dr.select(path.at_start, 1.0, balance(path.density, world.environment.density(path.direction, free)))
    return path.lit(path.carried * world.environment.radiance(path.direction, free) * weight, free)


def _first_noted(path: _Path, meets: _Meeting) -> _Path:
    point, surface, now = meets.point, meets.surface, meets.stands & path.at_start
    albedo = dr.select(point.unlit, point.base, surface.diffuse + surface.f0)
    return path._replace(
        first=dr.select(now, point.triangle, path.first),
        albedo=dr.select(now, albedo, path.albedo),
        normal=dr.select(now, surface.normal, path.normal),
    )


def _glowed_upon(world: World, path: _Path, meets: _Meeting) -> _Path:
    """By what the surface shines by itself."""
    point, weight = meets.point, mi.Float(1.0)
    if world.shining.any:
        facing = dr.dot(point.face, path.direction)
        weight = balance(path.density, world.shining.density(point.triangle, path.passed + meets.distance, facing, meets.stands))
        weight = dr.select(path.density > 0.0, weight, 1.0)
    glow = dr.select(point.unlit, point.base, meets.surface.emissive * weight)
    return path.lit(path.carried * glow, meets.stands & point.seen)


def _reflects_on(path: _Path, meets: _Meeting, most: Any) -> Any:
    return meets.stands & meets.point.seen & ~meets.point.unlit & (path.bounce < most)


def _gone_on(world: World, path: _Path, meets: _Meeting, reflects: Reflection, reflects_on: Any) -> _Path:
    """Through the surface, away from it in a drawn direction, or not at all: faint paths end by chance (Russian roulette)."""
    surface, sampler, through = meets.surface, path.sampler, meets.through
    onward = reflects.drawn(sampler.next_1d(reflects_on), sampler.next_2d(reflects_on))
    value, density = reflects.value(onward)
    carried = dr.select(reflects_on, path.carried * value / dr.maximum(density, 1e-20), path.carried)
    goes_on = reflects_on & (density > 0.0) & (dr.max(carried) > 0.0) & (dr.dot(surface.smooth, onward) > 0.0)
    survival = dr.select(path.bounce >= _SURE_BOUNCES, dr.clip(dr.max(carried), 0.05, 0.95), 1.0)
    goes_on &= sampler.next_1d(reflects_on) < survival
    return path._replace(
        origin=dr.select(through, world.past(meets.point, path.direction), dr.select(goes_on, surface.origin, path.origin)),
        direction=dr.select(goes_on, onward, path.direction),
        active=through | goes_on,
        bounce=dr.select(goes_on, path.bounce + 1, path.bounce),
        carried=dr.select(goes_on, carried / survival, carried),
        density=dr.select(goes_on, density, path.density),
        passed=dr.select(through, path.passed + meets.distance, 0.0),
    )
