"""World: meshes, lights and environment on the device, with the queries of path tracing."""

from collections.abc import Sequence
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from jaxtyping import Float, Float64

from mrbokeh.scene.light import Environment, Light
from mrbokeh.scene.mesh import Mesh
from mrbokeh.scene.mitsuba.light_sources import EnvironmentTables, PointLights, ShiningTriangles
from mrbokeh.scene.mitsuba.reflection import Reflection, ShareTable
from mrbokeh.scene.mitsuba.surfaces import Point, SurfaceTables
from mrbokeh.scene.packed_scene import OPAQUE, KeptTextures, packed
from mrbokeh.scene.virtual_scene import Scene

_STEP = 2.0**-18
"""Relative step off a surface, 32 float32 roundings: what keeps a ray from meeting again where it starts."""
_MOST_SHADOW_LAYERS = 16


def world_of(scene: Scene, surroundings: Sequence[Mesh], like: "World | None" = None) -> "World":
    """Build the world of a scene's drawn meshes and, behind their triangles, real surfaces. like: a world whose equal textures are
    reused.
    """
    drawn = scene.drawn_meshes
    # The middle of what is drawn: real surfaces may reach far, where nobody needs millimetres.
    points = np.concatenate([mesh.positions_m[mesh.triangles].reshape(-1, 3) for mesh in drawn or surroundings])
    centre_m = (points.min(0) + points.max(0)) / 2
    lights, environment = scene.lighting
    return World(meshes=[*drawn, *surroundings], lights=lights, environment=environment, centre_m=centre_m, like=like)


class World:
    """Meshes and lights relative to centre_m. All meshes take part in the light, also those that catch shadows."""

    def __init__(
        self,
        meshes: Sequence[Mesh],
        lights: Sequence[Light],
        environment: Environment | None,
        centre_m: Float64[np.ndarray, "3"],
        like: "World | None" = None,
    ) -> None:
        """Upload the meshes, at least one triangle. like: a world whose equal textures are reused."""
        triangles, materials, textures = packed(meshes, centre_m, None if like is None else like.textures)
        self.centre_m = centre_m
        self.textures: KeptTextures = textures
        gap_m = 2 * _STEP * float(np.abs(triangles.corners_m).max())
        self.surfaces = SurfaceTables(triangles, materials, textures.packed, gap_m)
        self.lights, self.shining = PointLights(lights, centre_m), ShiningTriangles(meshes, triangles.corners_m)
        self.environment = None if environment is None else EnvironmentTables(environment)
        self.shares, self._gap, self._far = ShareTable(), dr.opaque(mi.Float, gap_m), dr.opaque(mi.Float, 1.0 - 1e-5)
        opaque = materials.alpha_mode[triangles.material] == OPAQUE
        self._all = triangle_scene(triangles.corners_m)
        self._opaque = self._all if opaque.all() else triangle_scene(triangles.corners_m[opaque]) if opaque.any() else None
        self._see_through: Any = None if opaque.all() else triangle_scene(triangles.corners_m[~opaque])
        self._see_through_number = mi.UInt32(np.flatnonzero(~opaque).astype(np.uint32))

    def met(self, ray: Any, active: Any) -> Any:
        return self._all.ray_intersect_preliminary(ray, active=active)

    def past(self, point: Point, direction: Any) -> Any:
        """Return the point from which a ray continues that passes through a surface."""
        return point.position + direction * self._gap

    def open_share(self, origin: Any, towards: Any, distance: Any, active: Any) -> Any:
        """Return the share of light from a direction and distance that arrives: 0 behind opaque surfaces, the product of 1 - alpha
        behind others.
        """
        visible = dr.select(active, mi.Float(1.0), 0.0)
        if self._opaque is not None:
            ray = mi.Ray3f(origin, towards)
            ray.maxt = distance * self._far
            visible = dr.select(self._opaque.ray_test(ray, active=active), 0.0, visible)
        return visible if self._see_through is None else self._veiled(visible, origin, towards, distance)

    def _veiled(self, visible: Any, origin: Any, towards: Any, distance: Any) -> Any:
        def pass_one(start: Any, left: Any, visible: Any, layer: Any) -> tuple[Any, ...]:
            alive = visible > 0.0
            ray = mi.Ray3f(start, towards)
            ray.maxt = left
            hit = self._see_through.ray_intersect_preliminary(ray, active=alive)
            veils = alive & hit.is_valid()
            hit.prim_index = dr.gather(mi.UInt32, self._see_through_number, hit.prim_index, veils)
            point = self.surfaces.point(hit, towards, mi.Float(0.0), veils)
            visible = dr.select(veils, visible * (1.0 - point.alpha), visible)
            start = dr.select(veils, self.past(point, towards), start)
            left = dr.select(veils, left - hit.t - self._gap, -1.0)
            return start, left, visible, layer + 1

        state = (mi.Point3f(origin), mi.Float(distance * self._far) + dr.zeros(mi.Float, dr.width(visible)), visible, mi.UInt32(0))
        going = dr.while_loop(
            state, lambda _start, left, visible, layer: (left > 0.0) & (visible > 0.0) & (layer < _MOST_SHADOW_LAYERS), pass_one
        )
        return going[2]

    def point_lights(self, reflects: Reflection, active: Any) -> Any:
        """Radiance reflected from the lights without extent."""
        result = mi.Color3f(0.0)
        for number in range(len(self.lights)):
            result += self.point_light(number, reflects, active)
        return result

    def point_light(self, number: int, reflects: Reflection, active: Any) -> Any:
        surface = reflects.surface
        towards, distance, irradiance = self.lights.arriving(number, surface.origin)
        value, _density = reflects.value(towards)
        light = value * irradiance
        lit = active & (dr.max(light) > 0.0)
        arrives = self.open_share(surface.origin, towards, distance, lit) if self.lights.casts_shadow(number) else mi.Float(1.0)
        return dr.select(lit, light * arrives, 0.0)

    def shine(self, triangle: Any, place: Any, origin: Any, active: Any) -> tuple[Any, Any, Any, Any]:
        """Return (radiance of a point of a triangle towards an origin, direction to it, distance, density with which it is drawn)."""
        hit = dr.zeros(mi.PreliminaryIntersection3f, dr.width(triangle))
        hit.prim_index, hit.prim_uv = triangle, place
        at = self.surfaces.point(hit, mi.Vector3f(0.0, 0.0, 1.0), mi.Float(0.0), active)
        offset = at.position - origin
        distance = dr.maximum(dr.norm(offset), 1e-9)
        towards = offset / distance
        at = self.surfaces.point(hit, towards, mi.Float(0.0), active)
        emitted = self.surfaces.surface(at, towards, active).emissive
        density = self.shining.density(triangle, distance, dr.dot(at.face, towards), active)
        return dr.select(active & at.seen, emitted * at.alpha, 0.0), towards, distance, density


def triangle_scene(corners_m: Float[np.ndarray, "triangles 3 3"]) -> Any:
    """Mitsuba's scene of these triangles alone, in their order; it is asked for intersections only."""
    mesh = mi.Mesh("triangles", 3 * len(corners_m), len(corners_m))
    parameters = mi.traverse(mesh)
    parameters["vertex_positions"] = corners_m.astype(np.float32).ravel()
    parameters["faces"] = np.arange(3 * len(corners_m), dtype=np.uint32)
    parameters.update()
    return mi.load_dict({"type": "scene", "triangles": mesh})
