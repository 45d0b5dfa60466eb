"""Path tracing with multiple importance sampling (Veach 1997; Pharr, Jakob and Humphreys 2023, section 13.4), by Mitsuba's compiler.

Camera rays may have any focal lengths and principal point. At every surface, points of the environment and of emissive triangles are
drawn as well (next event estimation).
"""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, NamedTuple

import drjit as dr
import mitsuba as mi
import numpy as np
from jaxtyping import Float, Int64

from mrbokeh.optics.camera import Camera
from mrbokeh.scene.mitsuba.reflection import Reflection, reflection
from mrbokeh.scene.mitsuba.world import World
from mrbokeh.system.console import track

_SURE_BOUNCES = 3
"""From there on faint paths are ended by chance."""
_NOTHING = 0xFFFFFFFF
_RAYS_AT_ONCE = 1 << 20


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
    weight = balance(density, other_density) / dr.maximum(density, 1e-20)
    return dr.select(wanted, value * world.environment.radiance(towards, wanted) * (arrives * weight), 0.0)


def shining_light(world: World, origin: Any, value_of: Any, sampler: Any, active: Any) -> Any:
    """Return the light of a drawn point of the emissive triangles.

    value_of(direction) -> (BRDF times cosine, density of the other ways in which that direction is drawn).
    """
    which, place = world.shining.drawn(sampler.next_1d(active), sampler.next_2d(active), active)
    emitted, towards, distance, density = world.shine(which, place, origin, active)
    value, other_density = value_of(towards)
    wanted = active & (dr.max(value * emitted) > 0.0)
    arrives = world.open_share(origin, towards, distance, wanted)
    weight = balance(density, other_density) / dr.maximum(density, 1e-20)
    return dr.select(wanted, value * emitted * (arrives * weight), 0.0)


def balance(density: Any, other: Any) -> Any:
    """The balance heuristic: what counts of light drawn with one density where another way draws it too."""
    return density / dr.maximum(density + other, 1e-20)


@dataclass(frozen=True)
class Rays:
    """Starts of paths.

    density: of the directions per steradian if emissive triangles are drawn for as well, else 0. from_camera: surfaces that are
    invisible from behind let rays pass, and the environment does not count. width_per_m: width that a ray stands for at one metre.
    """

    origin: Any
    direction: Any
    active: Any
    from_camera: bool
    density: Any = 0.0
    width_per_m: Any = 0.0


@dataclass(frozen=True)
class PathResult:
    """Light along the rays. stands: whether there was a surface; first: number of its triangle; albedo, normal: of it."""

    radiance: Any
    stands: Any
    first: Any
    albedo: Any
    normal: Any


class _Path(NamedTuple):
    """State of every path.

    carried: the share of light that gets from here to the start. density: of the direction in which it was drawn. passed: metres from
    its start through surfaces that let it pass. first, albedo, normal: of the first surface that did not.
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
    """Surface that paths meet: met, and then through (the surface lets them pass) or stands. distance: to it in metres."""

    point: Any
    surface: Any
    distance: Any
    met: Any
    through: Any
    stands: Any


def followed(world: World, rays: Rays, sampler: Any, most_bounces: int) -> PathResult:
    """Radiance along rays. most_bounces: how many surfaces light may meet on its way; 1 is direct light only."""
    most = dr.opaque(mi.UInt32, most_bounces)
    start = tuple(_started(rays, sampler))
    ends = dr.while_loop(start, lambda *path: _Path(*path).active, lambda *path: tuple(_stepped(world, rays, most, _Path(*path))))
    path = _Path(*ends)
    finite = dr.isfinite(path.radiance.x + path.radiance.y + path.radiance.z)
    return PathResult(
        radiance=dr.select(finite, path.radiance, 0.0),
        stands=path.first != _NOTHING,
        first=path.first,
        albedo=path.albedo,
        normal=path.normal,
    )


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
    """Advance paths from one surface to the next. most: bounces."""
    meets = _meeting(world, rays, path)
    path = _lit_from_afar(world, rays, path, path.active & ~meets.met)
    path = _glowed_upon(world, _first_noted(path, meets), meets)
    reflects, reflects_on = reflection(meets.surface, world.shares), _reflects_on(path, meets, most)
    light = world.point_lights(reflects, reflects_on) + drawn_lights(world, reflects, path.sampler, reflects_on)
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
    return _Meeting(
        point=point, surface=world.surfaces.surface(point, path.direction, stands), distance=hit.t, met=met, through=through, stands=stands
    )


def _lit_from_afar(world: World, rays: Rays, path: _Path, missed: Any) -> _Path:
    """Add the environment's light to paths that met nothing."""
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
    """Add the light that the surface emits."""
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
    """Continue paths through the surface or in a drawn direction, or end them; faint paths end by chance (Russian roulette)."""
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


class CameraRays:
    """Rays through pixels, `samples` in each (rounded up to a grid), computed from the intrinsics themselves.

    Mitsuba's own cameras know square pixels only; and so no picture has to be resampled.
    """

    def __init__(self, camera: Camera, centre_m: Float[np.ndarray, "3"], samples: int) -> None:
        self._sampler = mi.load_dict({"type": "multijitter", "sample_count": samples})
        self.samples = int(self._sampler.sample_count())
        world_from_camera = camera.world_from_camera
        eye_m = world_from_camera[:3, 3] - centre_m
        numbers = [*(1.0 / np.asarray(camera.focal_px)), *camera.principal_px, *world_from_camera[:3, :3].ravel(), *eye_m]
        self._numbers, self._width_px = mi.Float(np.array(numbers, np.float32)), camera.width_px
        self._width_per_m = dr.opaque(mi.Float, (camera.focal_px[0] * camera.focal_px[1] * self.samples) ** -0.5)

    def parts(self, pixels: Int64[np.ndarray, " pixels"], seed: int, description: str) -> Iterator[tuple[Any, Any, Any, Any]]:
        """Yield (origin, direction, width that a ray stands for at one metre, sampler) for as many pixels as are traced at once.

        description: of the progress bar if there are several parts.
        """
        at_once = max(1, _RAYS_AT_ONCE // self.samples)
        starts = range(0, len(pixels), at_once)
        for number in track(starts, description) if len(starts) > 1 else starts:
            part = pixels[number : number + at_once]
            sampler = self._sampler.clone()
            sampler.set_samples_per_wavefront(self.samples)
            sampler.seed(seed * 0x10001 + number // at_once, self.samples * len(part))
            yield (*self._rays(part, sampler), self._width_per_m, sampler)

    def _rays(self, pixels: Int64[np.ndarray, " pixels"], sampler: Any) -> tuple[Any, Any]:
        lane = dr.arange(mi.UInt32, self.samples * len(pixels))
        pixel = dr.gather(mi.UInt32, mi.UInt32(pixels.astype(np.uint32)), lane // dr.opaque(mi.UInt32, self.samples))
        width, within = dr.opaque(mi.UInt32, self._width_px), sampler.next_2d()
        fx, fy, cx, cy, *rest = (dr.gather(mi.Float, self._numbers, mi.UInt32(entry)) for entry in range(16))
        row = pixel // width
        x, y = (mi.Float(pixel - row * width) + within.x - cx) * fx, (mi.Float(row) + within.y - cy) * fy
        towards = mi.Vector3f(*(rest[3 * axis] * x + rest[3 * axis + 1] * y + rest[3 * axis + 2] for axis in range(3)))
        return mi.Point3f(*rest[9:]), dr.normalize(towards)

    def means(self, seen: PathResult) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Return (share that stands (pixels,), radiance, albedo, normal (pixels, 3)): means over the rays of each pixel."""
        stands = dr.select(seen.stands, mi.Float(1.0), 0.0)
        share, *rest = self.sums(stands, *seen.radiance, *seen.albedo, *seen.normal)
        means = np.stack(rest, axis=-1) / np.float32(self.samples)
        return share / np.float32(self.samples), means[:, :3], means[:, 3:6], means[:, 6:]

    def sums(self, *values: Any) -> list[np.ndarray]:
        """Sums of numbers over the rays of each pixel."""
        count = max(dr.width(value) for value in values)
        values = tuple(mi.Float(value) + dr.zeros(mi.Float, count) for value in values)
        dr.eval(*values)  # together: else the paths are traced again for each of them
        sums = [dr.block_sum(value, self.samples) for value in values]
        dr.eval(sums)
        return [np.array(each) for each in sums]
