"""World: meshes and light sources on the device, with the queries of path tracing.

Light comes from the environment as a panorama, from lights without extent, and from emissive triangles.
"""

from collections.abc import Sequence
from math import cos
from typing import Any

import cv2
import drjit as dr
import mitsuba as mi
import numpy as np
from jaxtyping import Float, Float64

from mrbokeh.images.color import luminance
from mrbokeh.scene.light import Environment, Light, solid_angles_sr
from mrbokeh.scene.material import Texture
from mrbokeh.scene.mesh import Mesh
from mrbokeh.scene.mitsuba.reflection import Reflection, ShareTable
from mrbokeh.scene.mitsuba.surfaces import Point, SurfaceTables
from mrbokeh.scene.packed_scene import OPAQUE, KeptTextures, packed
from mrbokeh.scene.virtual_scene import Scene

_POINTS = np.array([[i + 1 / 3, j + 1 / 3] for i in range(6) for j in range(6 - i)]) / 6
"""Places (b1, b2) in a triangle at which its light is read."""


class EnvironmentTables:
    """A panorama on the device, read bilinearly as the ray caster reads it."""

    def __init__(self, environment: Environment) -> None:
        radiance = environment.radiance
        height, width = radiance.shape[:2]
        # One more texel all around: over a pole the panorama goes on at the opposite longitude.
        beyond = np.concatenate([np.roll(radiance[:1], width // 2, 1), radiance, np.roll(radiance[-1:], width // 2, 1)])
        beyond = np.concatenate([beyond[:, -1:], beyond, beyond[:, :1]], axis=1)
        self._texels = mi.Float(np.ascontiguousarray(beyond, np.float32).ravel())
        self._height, self._width = dr.opaque(mi.UInt32, height), dr.opaque(mi.UInt32, width)
        self._world_from_self = [mi.Float(row.astype(np.float32)) for row in np.asarray(environment.world_from_environment)]
        # Between texels light is mixed: so the light around a texel, not that of the texel alone, says how often it is drawn.
        around = cv2.blur(np.ascontiguousarray(luminance(beyond.astype(np.float64))), (3, 3), borderType=cv2.BORDER_REPLICATE)[1:-1, 1:-1]
        weights = np.maximum(around, 1e-12 + 1e-6 * around.max()) * solid_angles_sr(height, width)
        self._drawing = mi.DiscreteDistribution2D((weights / weights.sum()).astype(np.float32))

    def radiance(self, direction: Any, active: Any) -> Any:
        """Light that comes from a direction (unit vectors away from the scene, in the world)."""
        column, row = self._place(direction)
        x, y = column + 0.5, row + 0.5  # half-integer centres, and the border of one texel
        left, top = mi.UInt32(x), mi.UInt32(y)
        right, down = x - mi.Float(left), y - mi.Float(top)
        stride = self._width + 2
        corner = top * stride + left
        a, b, c, d = (dr.gather(mi.Color3f, self._texels, corner + step, active) for step in (0, 1, stride, stride + 1))
        return (1 - down) * ((1 - right) * a + right * b) + down * ((1 - right) * c + right * d)

    def drawn(self, uv: Any, active: Any) -> tuple[Any, Any]:
        """Return (direction, density per steradian) for uniform numbers."""
        texel, share, within = self._drawing.sample(uv, active)
        longitude = (mi.Float(texel.x) + within.x) / mi.Float(self._width) * dr.two_pi - dr.pi
        upper, lower = self._borders(texel.y)
        rising = dr.lerp(upper, lower, within.y)
        level = dr.safe_sqrt(1.0 - dr.square(rising))
        sine, cosine = dr.sincos(longitude)
        own = mi.Vector3f(level * sine, -rising, level * cosine)
        turned = [own.x * self._entry(row, 0) + own.y * self._entry(row, 1) + own.z * self._entry(row, 2) for row in range(3)]
        return mi.Vector3f(*turned), self._per_steradian(share, upper, lower)

    def density(self, direction: Any, active: Any) -> Any:
        """Return the density per steradian with which `drawn` gives a direction."""
        column, row = self._place(direction)
        texel = mi.Point2u(dr.minimum(mi.UInt32(column), self._width - 1), dr.minimum(mi.UInt32(row), self._height - 1))
        return self._per_steradian(self._drawing.pdf(texel, active), *self._borders(texel.y))

    def _borders(self, row: Any) -> tuple[Any, Any]:
        """Cosine of the polar angle at the upper and lower border of a row of the panorama."""
        return tuple(dr.cos(mi.Float(row + step) / mi.Float(self._height) * dr.pi) for step in (0, 1))  # type: ignore[return-value]

    def _per_steradian(self, share: Any, upper: Any, lower: Any) -> Any:
        return share * mi.Float(self._width) / (dr.two_pi * dr.maximum(upper - lower, 1e-12))

    def _place(self, direction: Any) -> tuple[Any, Any]:
        """Column and row of a direction."""
        own = [sum(direction[row] * self._entry(row, column) for row in range(3)) for column in range(3)]
        u, v = dr.atan2(own[0], own[2]) * dr.inv_two_pi + 0.5, dr.safe_acos(-own[1]) * dr.inv_pi
        return dr.clip(u, 0.0, 1.0) * mi.Float(self._width), dr.clip(v, 0.0, 1.0) * mi.Float(self._height)

    def _entry(self, row: int, column: int) -> Any:
        return dr.gather(mi.Float, self._world_from_self[row], mi.UInt32(column))


class PointLights:
    """Lights without extent; the plain twin is `Light.arriving_at`."""

    def __init__(self, lights: Sequence[Light], centre_m: Float[np.ndarray, "3"]) -> None:
        self._lights = lights
        rows = [
            [
                *light.rgb,
                *(np.asarray(light.position_m) - centre_m),
                *light.direction,
                1.0 / light.range_m,
                cos(light.outer_cone_rad),
                1.0 / max(1e-3, cos(light.inner_cone_rad) - cos(light.outer_cone_rad)),
            ]
            for light in lights
        ]
        self._rows = mi.Float(np.array(rows, np.float32).ravel())

    def __len__(self) -> int:
        return len(self._lights)

    def casts_shadow(self, number: int) -> bool:
        return self._lights[number].casts_shadow

    def arriving(self, number: int, point: Any) -> tuple[Any, Any, Any]:
        """Return (unit vectors towards the light, distance, irradiance on a surface facing it)."""
        entries = [dr.gather(mi.Float, self._rows, mi.UInt32(12 * number + entry)) for entry in range(12)]
        rgb, travel = mi.Color3f(*entries[:3]), mi.Vector3f(*entries[6:9])
        kind = self._lights[number].kind
        if kind == "directional":
            return -travel, mi.Float(dr.inf), rgb
        offset = mi.Point3f(*entries[3:6]) - point
        distance = dr.maximum(dr.norm(offset), 1e-9)
        towards = offset / distance
        share = dr.clip(1.0 - (distance * entries[9]) ** 4, 0.0, 1.0) / dr.square(distance)
        if kind == "spot":
            share *= dr.square(dr.clip((-dr.dot(towards, travel) - entries[10]) * entries[11], 0.0, 1.0))
        return towards, distance, rgb * share


class ShiningTriangles:
    """Triangles of emissive materials, drawn in proportion to their light."""

    def __init__(self, meshes: Sequence[Mesh], corners_m: Float64[np.ndarray, "triangles 3 3"]) -> None:
        areas = np.linalg.norm(np.cross(corners_m[:, 1] - corners_m[:, 0], corners_m[:, 2] - corners_m[:, 0]), axis=-1) / 2
        weights = areas * np.concatenate([_shine(mesh) for mesh in meshes])
        self.any = bool(weights.sum() > 0)
        if not self.any:
            return
        shares = weights / weights.sum()
        shining = np.flatnonzero(shares)
        self._numbers, self._drawing = mi.UInt32(shining.astype(np.uint32)), mi.DiscreteDistribution(shares[shining].astype(np.float32))
        self._per_area = mi.Float((shares / np.maximum(areas, 1e-300)).astype(np.float32))

    def drawn(self, which: Any, uv: Any, active: Any) -> tuple[Any, Any]:
        """Return (number of a triangle, place in it as two weights), evenly over its area."""
        index, _share = self._drawing.sample_pmf(which, active)
        return dr.gather(mi.UInt32, self._numbers, index, active), mi.warp.square_to_uniform_triangle(uv)

    def density(self, triangle: Any, distance: Any, cosine: Any, active: Any) -> Any:
        """Return the density with which a point of a triangle is drawn, per steradian of a viewer at a distance, tilted by a cosine."""
        per_area = dr.gather(mi.Float, self._per_area, triangle, active)
        return per_area * dr.square(distance) / dr.maximum(dr.abs(cosine), 1e-6)


def _shine(mesh: Mesh) -> Float[np.ndarray, " triangles"]:
    """Mean luminance of the radiance of each triangle of a mesh."""
    material = mesh.material
    factor = np.asarray(material.emissive, np.float64)
    if material.unlit or not factor.any():
        return np.zeros(len(mesh.triangles))
    texture = material.emissive_texture
    if texture is None:
        return np.full(len(mesh.triangles), luminance(factor[None])[0])
    places = np.concatenate([1.0 - _POINTS.sum(1, keepdims=True), _POINTS], axis=1)
    if texture.uv_set >= len(mesh.uvs):
        return np.full(len(mesh.triangles), luminance(factor[None])[0])
    uv = np.einsum("pk,tkc->tpc", places, mesh.uvs[texture.uv_set][mesh.triangles].astype(np.float64))
    return np.asarray(luminance(_nearest(texture, uv) * factor)).mean(1)


def _nearest(texture: Texture, uv: Float[np.ndarray, "triangles places 2"]) -> Float[np.ndarray, "triangles places 3"]:
    """Nearest texels: enough to say how often a triangle is drawn."""
    affine, size = np.asarray(texture.texture_from_uv), texture.texels.shape[:2]
    at = uv @ affine[:, :2].T + affine[:, 2]
    index = []
    for axis, wrap in enumerate(texture.wrap):
        s = at[..., axis]
        s = s - np.floor(s) if wrap == "repeat" else np.abs(s - 2 * np.round(s / 2)) if wrap == "mirror" else np.clip(s, 0.0, 1.0)
        index.append(np.minimum((s * size[1 - axis]).astype(int), size[1 - axis] - 1))
    return texture.texels[index[1], index[0], :3].astype(np.float64)


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
