"""Shading points of rays that meet triangles, by Mitsuba's compiler; the compiled twin is `_surface_numba`.

Packed textures are read bilinearly with wrap modes, from the level that has about one texel per ray.
"""

from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from mrbokeh.scene.packed_scene import MASK, MIRROR, OPAQUE, REPEAT, PackedMaterials, PackedTextures, PackedTriangles

BASE_COLOR, METALLIC_ROUGHNESS, EMISSIVE, NORMAL = range(4)
_Pair = tuple[Any, Any]


class TextureTables:
    """Packed textures on the device; the compiled twin is in `_surface_numba`."""

    def __init__(self, textures: PackedTextures) -> None:
        self._texels = mi.Float(textures.texels.ravel())
        self._level_start = mi.UInt32(textures.level_start.astype(np.uint32))
        self._level_size = mi.UInt32(textures.level_size.astype(np.uint32).ravel())
        self._first_level = mi.UInt32(textures.first_level.astype(np.uint32))
        self._wrap = mi.UInt32(textures.wrap.astype(np.uint32).ravel())
        self._uv_set = mi.UInt32(textures.uv_set.astype(np.uint32))
        self._affine = mi.Float(textures.texture_from_uv.ravel())

    def read(self, texture: Any, uv: tuple[Any, Any], width: tuple[Any, Any], active: Any) -> Any:
        """Return (r, g, b, a) of textures (by number) at uv, both sets of coordinates. width: that a ray stands for, in each set's
        coordinates.
        """
        second = dr.gather(mi.UInt32, self._uv_set, texture, active) == 1
        at, width = dr.select(second, uv[1], uv[0]), dr.select(second, width[1], width[0])
        m = [dr.gather(mi.Float, self._affine, 6 * texture + entry, active) for entry in range(6)]
        s, t = m[0] * at.x + m[1] * at.y + m[2], m[3] * at.x + m[4] * at.y + m[5]
        first, end = (dr.gather(mi.UInt32, self._first_level, texture + step, active) for step in (0, 1))
        size = dr.gather(mi.Vector2u, self._level_size, first, active)
        texels = width * dr.sqrt(mi.Float(size.x) * mi.Float(size.y) * dr.abs(m[0] * m[4] - m[1] * m[3]))
        level = dr.minimum(first + mi.UInt32(dr.log2(dr.maximum(texels, 1.0))), end - 1)
        return self._bilinear(texture, level, s, t, active)

    def _bilinear(self, texture: Any, level: Any, s: Any, t: Any, active: Any) -> Any:
        start = dr.gather(mi.UInt32, self._level_start, level, active)
        size = mi.Vector2i(dr.gather(mi.Vector2u, self._level_size, level, active))
        wrap = dr.gather(mi.Vector2u, self._wrap, texture, active)
        (left, right, x), (top, bottom, y) = _neighbours(s, size.y, wrap.x), _neighbours(t, size.x, wrap.y)
        a, b, c, d = (
            dr.gather(mi.Vector4f, self._texels, start + mi.UInt32(row * size.y + column), active)
            for row, column in ((top, left), (top, right), (bottom, left), (bottom, right))
        )
        return (1 - y) * ((1 - x) * a + x * b) + y * ((1 - x) * c + x * d)


def _neighbours(s: Any, size: Any, wrap: Any) -> tuple[Any, Any, Any]:
    """Return (texel before, texel after, distance between their centres) of a coordinate in [0, 1] and beyond."""
    folded = dr.abs(s - 2 * dr.round(s / 2))
    s = dr.select(wrap == REPEAT, s - dr.floor(s), dr.select(wrap == MIRROR, folded, dr.clip(s, 0.0, 1.0)))
    x = s * mi.Float(size) - 0.5
    low = mi.Int32(dr.floor(x))
    repeats = wrap == REPEAT
    before = dr.select(low < 0, dr.select(repeats, size - 1, 0), low)
    after = dr.select(low + 1 >= size, dr.select(repeats, 0, size - 1), low + 1)
    return before, after, x - dr.floor(x)


@dataclass(frozen=True)
class Point:
    """Point at which a ray meets a triangle: facing is 1 in front of it and -1 behind, face its unit normal on the viewer's side."""

    triangle: Any
    weights: tuple[Any, Any, Any]
    material: Any
    position: Any
    face: Any
    facing: Any
    double_sided: Any
    unlit: Any
    uv: _Pair
    width: _Pair
    base: Any
    alpha: Any
    seen: Any


@dataclass(frozen=True)
class Surface:
    """Surface at a Point. origin: start of rays from here. diffuse: albedo below the reflection.

    smooth: the normal without its map; directions below it are in the surface.
    """

    normal: Any
    smooth: Any
    origin: Any
    to_viewer: Any
    diffuse: Any
    f0: Any
    f90: Any
    roughness: Any
    emissive: Any


class SurfaceTables:
    """Triangles, materials and textures on the device. The occlusion texture is not read: here the light itself is occluded."""

    def __init__(self, triangles: PackedTriangles, materials: PackedMaterials, textures: PackedTextures, gap_m: float) -> None:
        self._corners, self._normals = mi.Float(triangles.corners_m.astype(np.float32).ravel()), mi.Float(triangles.normals.ravel())
        self._material = mi.UInt32(triangles.material.astype(np.uint32))
        slots = materials.textures[:, :4]
        self._used = [bool((slots[:, slot] >= 0).any()) for slot in range(4)]
        self._textured, self._tinted = any(self._used), bool((triangles.colors != 1.0).any())
        if self._textured:
            self._textures, self._slots = TextureTables(textures), mi.Int32(slots.astype(np.int32).ravel())
            self._uvs, self._uv_density = mi.Float(triangles.uvs.ravel()), mi.Float(triangles.uv_density.ravel())
        if self._tinted:
            self._colors = mi.Float(triangles.colors.ravel())
        if self._used[NORMAL]:
            self._tangents = mi.Float(triangles.tangents.ravel())
        self._rows = mi.Float(_material_rows(materials).ravel())
        self._gap = dr.opaque(mi.Float, gap_m)

    def point(self, hit: Any, direction: Any, width: Any, active: Any) -> Point:
        """Return the points of a hit. width: that the ray stands for, in metres."""
        triangle, b1, b2 = hit.prim_index, hit.prim_uv.x, hit.prim_uv.y
        weights = (1.0 - b1 - b2, b1, b2)
        a, b, c = self._three(mi.Point3f, self._corners, triangle, active)
        face = dr.normalize(dr.cross(b - a, c - a))
        facing = dr.select(dr.dot(face, direction) < 0.0, mi.Float(1.0), -1.0)
        material = dr.gather(mi.UInt32, self._material, triangle, active)
        flags = dr.gather(mi.Vector4f, self._rows, 5 * material + 4, active)
        cosine = dr.maximum(dr.abs(dr.dot(face, direction)), 0.05)
        uv, uv_width = self._texture_coordinates(triangle, weights, width / dr.sqrt(cosine), active)
        base, alpha = self._base_color(triangle, material, weights, uv, uv_width, flags, active)
        position, double_sided = _mixed(weights, a, b, c), flags.x > 0.5
        seen = (facing > 0.0) | double_sided
        return Point(
            triangle=triangle,
            weights=weights,
            material=material,
            position=position,
            face=face * facing,
            facing=facing,
            double_sided=double_sided,
            unlit=flags.y > 0.5,
            uv=uv,
            width=uv_width,
            base=base,
            alpha=alpha,
            seen=seen,
        )

    def surface(self, point: Point, direction: Any, active: Any) -> Surface:
        a, b, c = self._three(mi.Point3f, self._corners, point.triangle, active)
        normals = self._three(mi.Vector3f, self._normals, point.triangle, active)
        smooth = dr.normalize(_mixed(point.weights, *normals)) * point.facing
        # Rays start on the smooth surface that the triangles stand for (Hanika 2021, "Hacking the Shadow Terminator").
        below = [
            dr.minimum(0.0, point.facing * dr.dot(point.position - corner, normal))
            for corner, normal in zip((a, b, c), normals, strict=True)
        ]
        lift = _mixed(tuple(share * depth for share, depth in zip(point.weights, below, strict=True)), *normals) * point.facing
        row = [dr.gather(mi.Vector4f, self._rows, 5 * point.material + column, active) for column in (1, 2, 3)]
        metallic, roughness = row[0].x, row[0].y
        emissive = mi.Color3f(row[1].x, row[1].y, row[1].z)
        if self._used[METALLIC_ROUGHNESS]:
            texel = self._texel(METALLIC_ROUGHNESS, point, active)
            metallic, roughness = metallic * texel.z, roughness * texel.y
        if self._used[EMISSIVE]:
            texel = self._texel(EMISSIVE, point, active)
            emissive = emissive * mi.Color3f(texel.x, texel.y, texel.z)
        f0 = mi.Color3f(row[2].x, row[2].y, row[2].z)
        return Surface(
            normal=self._mapped(point, smooth, row[0].z, active),
            smooth=smooth,
            origin=point.position - lift + point.face * self._gap,
            to_viewer=-direction,
            diffuse=point.base * (1.0 - metallic),
            f0=f0 + metallic * (point.base - f0),
            f90=row[1].w + metallic * (1.0 - row[1].w),
            roughness=dr.clip(roughness, 0.0, 1.0),
            emissive=emissive,
        )

    def _three(self, kind: Any, table: Any, triangle: Any, active: Any) -> list[Any]:
        return [dr.gather(kind, table, 3 * triangle + corner, active) for corner in range(3)]

    def _texture_coordinates(self, triangle: Any, weights: tuple[Any, Any, Any], width: Any, active: Any) -> tuple[_Pair, _Pair]:
        if not self._textured:
            nowhere = mi.Point2f(0.0)
            return (nowhere, nowhere), (mi.Float(0.0), mi.Float(0.0))
        uv = _mixed(weights, *self._three(mi.Vector4f, self._uvs, triangle, active))
        density = dr.gather(mi.Vector2f, self._uv_density, triangle, active)
        return (mi.Point2f(uv.x, uv.y), mi.Point2f(uv.z, uv.w)), (width * density.x, width * density.y)

    def _base_color(
        self, triangle: Any, material: Any, weights: tuple[Any, Any, Any], uv: _Pair, width: _Pair, flags: Any, active: Any
    ) -> _Pair:
        base = dr.gather(mi.Vector4f, self._rows, 5 * material, active)
        if self._tinted:
            base = base * _mixed(weights, *self._three(mi.Vector4f, self._colors, triangle, active))
        if self._used[BASE_COLOR]:
            base = base * self._read(BASE_COLOR, material, uv, width, active)
        cut = dr.select(base.w >= flags.w, mi.Float(1.0), 0.0)
        alpha = dr.select(flags.z == OPAQUE, 1.0, dr.select(flags.z == MASK, cut, dr.clip(base.w, 0.0, 1.0)))
        return mi.Color3f(base.x, base.y, base.z), alpha

    def _texel(self, slot: int, point: Point, active: Any) -> Any:
        return self._read(slot, point.material, point.uv, point.width, active)

    def _read(self, slot: int, material: Any, uv: _Pair, width: _Pair, active: Any) -> Any:
        """A material's texture, white where it has none."""
        number = dr.gather(mi.Int32, self._slots, 4 * material + slot, active)
        has = active & (number >= 0)
        return dr.select(has, self._textures.read(mi.UInt32(dr.maximum(number, 0)), uv, width, has), mi.Vector4f(1.0))

    def _mapped(self, point: Point, smooth: Any, scale: Any, active: Any) -> Any:
        """The smooth normal tilted by the normal map (glTF 2.0, section 3.9.3)."""
        if not self._used[NORMAL]:
            return smooth
        tangents = self._three(mi.Vector4f, self._tangents, point.triangle, active)
        mixed = _mixed(point.weights, *tangents)
        along = mi.Vector3f(mixed.x, mixed.y, mixed.z)
        along = along - smooth * dr.dot(smooth, along)
        number = dr.gather(mi.Int32, self._slots, 4 * point.material + NORMAL, active)
        texel = self._texel(NORMAL, point, active) * 2.0 - 1.0
        # `smooth` is already on the viewer's side, while the tangent frame belongs to the front.
        tilt = scale * point.facing
        along = dr.normalize(along)
        across = dr.cross(smooth, along) * tangents[0].w * point.facing
        tilted = dr.normalize(along * texel.x * tilt + across * texel.y * tilt + smooth * texel.z)
        return dr.select((number >= 0) & dr.all(dr.isfinite(tilted)), tilted, smooth)


def _material_rows(materials: PackedMaterials) -> np.ndarray:
    """Return (materials, 20): rows that are gathered four numbers at a time."""
    count = len(materials.f90)
    rows = np.zeros((count, 5, 4), np.float32)
    rows[:, 0] = materials.base_color
    rows[:, 1, :2], rows[:, 1, 2] = materials.metallic_roughness, materials.normal_scale
    rows[:, 2, :3], rows[:, 2, 3] = materials.emissive, materials.f90
    rows[:, 3, :3] = materials.f0
    rows[:, 4] = np.stack([materials.double_sided, materials.unlit, materials.alpha_mode, materials.alpha_cutoff], axis=-1)
    return rows


def _mixed(weights: tuple[Any, ...], a: Any, b: Any, c: Any) -> Any:
    return weights[0] * a + weights[1] * b + weights[2] * c
