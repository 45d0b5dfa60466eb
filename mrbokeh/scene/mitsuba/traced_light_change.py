"""The change of light on a real surface by path tracing; see `light_change`.

Only light from directions that meet an object changes, so besides the surface's reflection and the environment also the cone around
the objects is drawn from (three ways, one balance heuristic; Veach 1997). Paths with and without the objects share all random
numbers: where nothing changes, the difference is exactly nothing.
"""

from dataclasses import dataclass, replace
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from jaxtyping import Float64

from mrbokeh.optics.camera import Camera
from mrbokeh.scene.changed_light import LightChange, changed, seen_surface
from mrbokeh.scene.material import Material
from mrbokeh.scene.mesh import Mesh
from mrbokeh.scene.mitsuba.mitsuba_tracer import MitsubaTracer
from mrbokeh.scene.mitsuba.paths import CameraRays, Rays, followed, shining_light
from mrbokeh.scene.mitsuba.reflection import Reflection, reflection
from mrbokeh.scene.mitsuba.world import World, world_of
from mrbokeh.scene.virtual_scene import Scene

_SAME = 1e-5
"""Relative difference up to which two paths are the same but for rounding."""


def traced_light_change(tracer: MitsubaTracer, scene: Scene, camera: Camera, catcher: Mesh, surface: Material) -> LightChange:
    seen = seen_surface(tracer.caster, camera, catcher)
    real = replace(catcher, catches_shadow=False, material=replace(surface, double_sided=True))
    pixels = np.flatnonzero(seen.alpha > 0)
    nothing = np.zeros((len(pixels), 3), np.float32)
    if not scene.drawn_meshes or not len(pixels):
        return changed(seen, pixels, (nothing, nothing, nothing))
    tracer.prepare()
    table = _Table(scene, real)
    lens, parts = CameraRays(camera, table.centre_m, tracer.samples), []
    for origin, direction, _width, sampler in lens.parts(pixels, tracer.seed, "tracing the change of light"):
        sums = [lens.sums(*each) for each in table.light(origin, direction, sampler, tracer.most_bounces)]
        parts.append(np.sum(sums, axis=0))
    met, *light = np.concatenate(parts, axis=1)
    means = (np.stack(light, axis=-1) / np.maximum(met, 1.0)[:, None]).astype(np.float32)
    return changed(seen, pixels, (means[:, :3], means[:, 3:6], means[:, 6:]))


@dataclass(frozen=True)
class _Ball:
    """A ball around the objects, as the cone of directions in which a point sees it."""

    centre: Any
    radius: Any

    def cone(self, origin: Any) -> tuple[Any, Any, Any]:
        """Return (direction of the axis, squared sine of the half angle, 1 - its cosine); nothing is drawn from within the ball."""
        offset = self.centre - origin
        sine2 = dr.square(self.radius) / dr.squared_norm(offset)
        return dr.normalize(offset), sine2, sine2 / (1.0 + dr.safe_sqrt(1.0 - sine2))

    def drawn(self, origin: Any, uv: Any) -> Any:
        axis, _sine2, versine = self.cone(origin)
        off = uv.x * versine
        sine, cosine = dr.sincos(dr.two_pi * uv.y)
        level = dr.safe_sqrt(off * (2.0 - off))
        return mi.Frame3f(axis).to_world(mi.Vector3f(level * cosine, level * sine, 1.0 - off))

    def density(self, origin: Any, direction: Any) -> Any:
        axis, sine2, versine = self.cone(origin)
        # By the sine: in a narrow cone all cosines round to 1.
        within = (dr.squared_norm(dr.cross(axis, direction)) <= sine2 * 1.0001) & (dr.dot(axis, direction) > 0.0) & (sine2 < 1.0)
        return dr.select(within, 1.0 / (dr.two_pi * dr.maximum(versine, 1e-20)), 0.0)


class _Table:
    """A real surface with and without the objects."""

    def __init__(self, scene: Scene, real: Mesh) -> None:
        self._both = world_of(scene, [real])
        self.centre_m = self._both.centre_m
        lights, environment = scene.lighting
        self._real = World([real], lights, environment, self.centre_m)
        self._object_triangles = sum(len(mesh.triangles) for mesh in scene.drawn_meshes)
        self._ball = _ball_around(scene, self.centre_m)

    def light(self, origin: Any, direction: Any, sampler: Any, most_bounces: int) -> list[tuple[Any, ...]]:
        """Return, part by part: (whether rays meet the surface, its light, the light taken of it, the light added)."""
        hit = self._real.met(mi.Ray3f(origin, direction), mi.Bool(True))
        met = hit.is_valid()
        point = self._real.surfaces.point(hit, direction, mi.Float(0.0), met)
        reflects = reflection(self._real.surfaces.surface(point, direction, met), self._real.shares)
        parts = [self._point_lights(reflects, sampler, met)]
        for way in range(3):
            if way != 1 or self._real.environment is not None:
                parts.append(self._one_way(way, reflects, sampler, met, most_bounces))
        return parts

    def _point_lights(self, reflects: Reflection, sampler: Any, met: Any) -> tuple[Any, ...]:
        total, taken, added = mi.Color3f(0.0), mi.Color3f(0.0), mi.Color3f(0.0)
        for number in range(len(self._real.lights)):
            without, beside = (world.point_light(number, reflects, met) for world in (self._real, self._both))
            total, taken = total + without, taken + dr.maximum(without - beside, 0.0)
        if self._both.shining.any:
            added = shining_light(self._both, reflects.surface.origin, lambda towards: self._value(reflects, towards), sampler, met)
        return dr.select(met, mi.Float(1.0), 0.0), *total, *taken, *added

    def _value(self, reflects: Reflection, towards: Any) -> tuple[Any, Any]:
        """Return (BRDF times cosine, density of a direction in all ways together)."""
        value, density = reflects.value(towards)
        density = density + self._ball.density(reflects.surface.origin, towards)
        if self._real.environment is not None:
            density = density + self._real.environment.density(towards, mi.Bool(True))
        return value, density

    def _one_way(self, way: int, reflects: Reflection, sampler: Any, met: Any, most_bounces: int) -> tuple[Any, ...]:
        """Return the part of one way of drawing: 0 from the reflection, 1 from the environment, 2 from the cone around the objects."""
        origin, which, uv = reflects.surface.origin, sampler.next_1d(), sampler.next_2d()
        if way == 0:
            towards = reflects.drawn(which, uv)
        elif way == 1:
            assert self._real.environment is not None
            towards, _density = self._real.environment.drawn(uv, met)
        else:
            towards = self._ball.drawn(origin, uv)
        value, density = self._value(reflects, towards)
        wanted = met & (dr.max(value) > 0.0) & (density > 0.0) & dr.all(dr.isfinite(towards))
        if way == 2:
            wanted &= self._ball.density(origin, towards) > 0.0
        rays = Rays(origin, towards, wanted, from_camera=False, density=density)
        beside, without = (followed(world, rays, sampler.clone(), max(most_bounces - 1, 0)) for world in (self._both, self._real))
        share = dr.select(wanted, value / dr.maximum(density, 1e-20), 0.0)
        onto_object = beside.first < self._object_triangles
        more = beside.radiance - without.radiance
        more = dr.select(dr.abs(more) > _SAME * without.radiance, more, 0.0)
        taken = dr.select(onto_object, without.radiance, dr.maximum(-more, 0.0))
        added = dr.select(onto_object, beside.radiance, dr.maximum(more, 0.0))
        return mi.Float(0.0) * origin.x, *(share * without.radiance), *(share * taken), *(share * added)


def _ball_around(scene: Scene, centre_m: Float64[np.ndarray, "3"]) -> _Ball:
    points_m = np.concatenate([mesh.positions_m[np.unique(mesh.triangles)] for mesh in scene.drawn_meshes]) - centre_m
    middle_m = (points_m.min(0) + points_m.max(0)) / 2
    radius_m = float(np.linalg.norm(points_m - middle_m, axis=1).max()) * 1.0001
    return _Ball(mi.Point3f(*(dr.opaque(mi.Float, float(each)) for each in middle_m)), dr.opaque(mi.Float, radius_m))
