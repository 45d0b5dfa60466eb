"""Lamps for path tracing: lights without extent, and triangles that shine."""

from collections.abc import Sequence
from math import cos
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from jaxtyping import Float, Float64

from mrbokeh.images.color import luminance
from mrbokeh.scene.light import Light
from mrbokeh.scene.material import Texture
from mrbokeh.scene.mesh import Mesh

_POINTS = np.array([[i + 1 / 3, j + 1 / 3] for i in range(6) for j in range(6 - i)]) / 6
"""Places (b1, b2) in a triangle at which its light is read."""


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
        """(unit vectors towards the light, distance, irradiance on a surface facing it)."""
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
        """(number of a triangle, place in it as two weights), evenly over its area."""
        index, _share = self._drawing.sample_pmf(which, active)
        return dr.gather(mi.UInt32, self._numbers, index, active), mi.warp.square_to_uniform_triangle(uv)

    def density(self, triangle: Any, distance: Any, cosine: Any, active: Any) -> Any:
        """How often a point of a triangle is drawn, per steradian of whoever sees it at a distance, tilted by a cosine."""
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
