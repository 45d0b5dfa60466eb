"""Light sources for path tracing: the environment as a panorama, lights without extent, and emissive triangles."""

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
