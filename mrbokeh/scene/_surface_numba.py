"""Shading points of rays that meet triangles: exact depth, normals, textures. Compiled with numba.

Textures are read bilinearly with wrap modes, trilinearly over coarser levels.
"""

from math import floor, inf, log2, sqrt
from typing import NamedTuple

import numpy as np

from mrbokeh.scene._vectors_numba import Vector, compiled, corner, cross, dot, mixed, row, scaled, sub, unit3, write
from mrbokeh.scene.packed_scene import CLAMP, MASK, MIRROR, OPAQUE, PackedMaterials, PackedTextures, PackedTriangles

Texel = tuple[float, float, float, float]


@compiled
def _wrapped(index: int, size: int, wrap: int) -> int:
    if 0 <= index < size:
        return index  # by far most often, and a division costs as much as the rest of a lookup
    if wrap == CLAMP:
        return min(max(index, 0), size - 1)
    if wrap == MIRROR:
        index = index % (2 * size)
        return index if index < size else 2 * size - 1 - index
    return index % size


@compiled
def _bilinear(textures: PackedTextures, texture: int, level: int, s: float, t: float) -> Texel:
    """One level of a texture at (s, t) in [0, 1]; texel centres lie at half-integers."""
    height, width = textures.level_size[level, 0], textures.level_size[level, 1]
    start = textures.level_start[level]
    wrap_s, wrap_t = textures.wrap[texture, 0], textures.wrap[texture, 1]
    x, y = s * width - 0.5, t * height - 0.5
    x_low, y_low = floor(x), floor(y)
    right, down = x - x_low, y - y_low
    x0, x1 = _wrapped(x_low, width, wrap_s), _wrapped(x_low + 1, width, wrap_s)
    y0, y1 = _wrapped(y_low, height, wrap_t), _wrapped(y_low + 1, height, wrap_t)
    # Unsigned, so that no index is tried for being negative.
    a, b = np.uintp(start + y0 * width + x0), np.uintp(start + y0 * width + x1)
    c, d = np.uintp(start + y1 * width + x0), np.uintp(start + y1 * width + x1)
    w_a, w_b, w_c, w_d = (1 - right) * (1 - down), right * (1 - down), (1 - right) * down, right * down
    v = textures.texels
    return (
        w_a * v[a, 0] + w_b * v[b, 0] + w_c * v[c, 0] + w_d * v[d, 0],
        w_a * v[a, 1] + w_b * v[b, 1] + w_c * v[c, 1] + w_d * v[d, 1],
        w_a * v[a, 2] + w_b * v[b, 2] + w_c * v[c, 2] + w_d * v[d, 2],
        w_a * v[a, 3] + w_b * v[b, 3] + w_c * v[c, 3] + w_d * v[d, 3],
    )


@compiled
def read_texture(textures: PackedTextures, texture: int, uv: Texel, footprint: tuple[float, float]) -> Texel:
    """A texture at uv (two sets of coordinates) where it has about one texel per ray.

    footprint: width of what the ray stands for, in each set's coordinates.
    """
    uv_set = textures.uv_set[texture]
    u, v = uv[2 * uv_set], uv[2 * uv_set + 1]
    m = textures.texture_from_uv
    s = m[texture, 0, 0] * u + m[texture, 0, 1] * v + m[texture, 0, 2]
    t = m[texture, 1, 0] * u + m[texture, 1, 1] * v + m[texture, 1, 2]
    stretch = abs(m[texture, 0, 0] * m[texture, 1, 1] - m[texture, 0, 1] * m[texture, 1, 0])
    first, end = textures.first_level[texture], textures.first_level[texture + 1]
    detail = footprint[uv_set] * sqrt(float(textures.level_size[first, 0]) * textures.level_size[first, 1] * stretch)
    if detail <= 1.0:
        return _bilinear(textures, texture, first, s, t)
    level = min(log2(detail), float(end - first - 1))
    low = int(level)
    fine = _bilinear(textures, texture, first + low, s, t)
    coarse = _bilinear(textures, texture, min(first + low + 1, end - 1), s, t)
    f = level - low
    return (
        fine[0] + f * (coarse[0] - fine[0]),
        fine[1] + f * (coarse[1] - fine[1]),
        fine[2] + f * (coarse[2] - fine[2]),
        fine[3] + f * (coarse[3] - fine[3]),
    )


class Surfaces(NamedTuple):
    """Shading points of N rays (arrays that `fill_surfaces` writes)."""

    depth: np.ndarray  # (N,) float64 along the optical axis, inf where nothing is met
    alpha: np.ndarray  # (N,) how much the surface covers; 0 where there is none or it is seen from its invisible side
    mesh: np.ndarray  # (N,) int32 index of the mesh, -1 for none
    to_viewer: np.ndarray  # (N, 3) unit, towards the camera
    face_normal: np.ndarray  # (N, 3) unit, of the triangle, on the viewer's side
    smooth_normal: np.ndarray  # (N, 3) unit, interpolated
    normal: np.ndarray  # (N, 3) unit, with the normal map
    shadow_origin: np.ndarray  # (N, 3) float64, where shadow rays start
    base: np.ndarray  # (N, 3) base colour
    diffuse: np.ndarray  # (N, 3) Lambertian albedo before the reflection on top is taken off
    f0: np.ndarray  # (N, 3) reflectance at normal incidence
    f90: np.ndarray  # (N,) reflectance at grazing incidence
    roughness: np.ndarray  # (N,) perceptual; -1 marks an unlit surface
    occlusion: np.ndarray  # (N,)
    emissive: np.ndarray  # (N, 3)


def empty_surfaces(count: int) -> Surfaces:
    """Room for `count` shading points."""

    def vectors(dtype: type = np.float32) -> np.ndarray:
        return np.zeros((count, 3), dtype)

    def scalars(dtype: type = np.float32) -> np.ndarray:
        return np.zeros(count, dtype)

    return Surfaces(
        depth=scalars(np.float64),
        alpha=scalars(),
        mesh=scalars(np.int32),
        to_viewer=vectors(),
        face_normal=vectors(),
        smooth_normal=vectors(),
        normal=vectors(),
        shadow_origin=vectors(np.float64),
        base=vectors(),
        diffuse=vectors(),
        f0=vectors(),
        f90=scalars(),
        roughness=scalars(),
        occlusion=scalars(),
        emissive=vectors(),
    )


@compiled
def fill_surfaces(
    triangles: PackedTriangles,
    materials: PackedMaterials,
    textures: PackedTextures,
    origins: np.ndarray,
    directions: np.ndarray,
    hits: np.ndarray,
    footprint_per_depth: float,
    both_sides: bool,
    out: Surfaces,
) -> None:
    """Write the shading points of rays origin + depth * direction.

    origins: (N, 3), or (1, 3) for all rays. directions: 1 long along the optical axis where depth is to be along it.
    hits: (N,) triangle of each ray or -1. footprint_per_depth: width of a pixel at unit depth.
    both_sides: single-sided surfaces count from behind too (as they do for shadows).
    """
    for i in range(hits.size):
        triangle = hits[i]
        out.depth[i], out.alpha[i], out.mesh[i] = inf, 0.0, -1
        if triangle < 0:
            continue
        ray, origin = row(directions, i), row(origins, min(i, origins.shape[0] - 1))
        a, b, c = (
            corner(triangles.corners_m, triangle, 0),
            corner(triangles.corners_m, triangle, 1),
            corner(triangles.corners_m, triangle, 2),
        )
        # Where the ray meets the triangle's plane (Moeller and Trumbore 1997), in double precision.
        side_1, side_2, to_origin = sub(b, a), sub(c, a), sub(origin, a)
        p, q = cross(ray, side_2), cross(to_origin, side_1)
        determinant = dot(p, side_1)
        if determinant == 0.0:
            continue
        w1 = min(max(dot(p, to_origin) / determinant, 0.0), 1.0)
        w2 = min(max(dot(q, ray) / determinant, 0.0), 1.0 - w1)
        weights = (1.0 - w1 - w2, w1, w2)
        out.depth[i], out.mesh[i] = dot(q, side_2) / determinant, triangles.mesh[triangle]
        face = cross(side_1, side_2)
        facing = 1.0 if dot(face, ray) < 0.0 else -1.0
        material = triangles.material[triangle]
        if facing < 0.0 and not (both_sides or materials.double_sided[material]):
            continue
        write(out.to_viewer, i, unit3(scaled(ray, -1.0)))
        write(out.face_normal, i, scaled(unit3(face), facing))
        uv = _texture_coordinates(triangles.uvs, triangle, weights)
        footprint = _footprint(
            triangles.uv_density, triangle, footprint_per_depth * out.depth[i], row(out.face_normal, i), row(out.to_viewer, i)
        )
        base, alpha = _base_color(triangles.colors, materials, textures, triangle, material, weights, uv, footprint)
        out.alpha[i] = alpha
        if alpha > 0.0:
            _fill_shape(triangles, materials, textures, triangle, weights, facing, uv, footprint, i, out)
            _fill_material(materials, textures, material, base, uv, footprint, i, out)


@compiled
def _texture_coordinates(uvs: np.ndarray, triangle: int, w: Vector) -> Texel:
    """Interpolate both sets of texture coordinates inside a triangle."""
    return (
        w[0] * uvs[triangle, 0, 0] + w[1] * uvs[triangle, 1, 0] + w[2] * uvs[triangle, 2, 0],
        w[0] * uvs[triangle, 0, 1] + w[1] * uvs[triangle, 1, 1] + w[2] * uvs[triangle, 2, 1],
        w[0] * uvs[triangle, 0, 2] + w[1] * uvs[triangle, 1, 2] + w[2] * uvs[triangle, 2, 2],
        w[0] * uvs[triangle, 0, 3] + w[1] * uvs[triangle, 1, 3] + w[2] * uvs[triangle, 2, 3],
    )


@compiled
def _footprint(uv_density: np.ndarray, triangle: int, width_m: float, face: Vector, to_viewer: Vector) -> tuple[float, float]:
    """Width of a pixel on the surface in texture coordinates: the mean of its two axes (ray cones, Akenine-Moeller 2021)."""
    width_m = width_m / sqrt(max(dot(face, to_viewer), 0.05))
    return (width_m * uv_density[triangle, 0], width_m * uv_density[triangle, 1])


@compiled
def _base_color(
    colors: np.ndarray,
    materials: PackedMaterials,
    textures: PackedTextures,
    triangle: int,
    material: int,
    w: Vector,
    uv: Texel,
    footprint: tuple[float, float],
) -> tuple[Vector, float]:
    """Factor times texture times vertex colour, and how much it covers under the material's alpha mode."""
    tint = mixed(corner(colors, triangle, 0), corner(colors, triangle, 1), corner(colors, triangle, 2), w)
    factor = materials.base_color
    base = (factor[material, 0] * tint[0], factor[material, 1] * tint[1], factor[material, 2] * tint[2])
    alpha = factor[material, 3] * (w[0] * colors[triangle, 0, 3] + w[1] * colors[triangle, 1, 3] + w[2] * colors[triangle, 2, 3])
    texture = materials.textures[material, 0]
    if texture >= 0:
        texel = read_texture(textures, texture, uv, footprint)
        base = (base[0] * texel[0], base[1] * texel[1], base[2] * texel[2])
        alpha = alpha * texel[3]
    if materials.alpha_mode[material] == OPAQUE:
        alpha = 1.0
    elif materials.alpha_mode[material] == MASK:
        alpha = 1.0 if alpha >= materials.alpha_cutoff[material] else 0.0
    return base, min(max(alpha, 0.0), 1.0)


@compiled
def _fill_shape(
    triangles: PackedTriangles,
    materials: PackedMaterials,
    textures: PackedTextures,
    triangle: int,
    w: Vector,
    facing: float,
    uv: Texel,
    footprint: tuple[float, float],
    i: int,
    out: Surfaces,
) -> None:
    """Normals and the start of shadow rays."""
    a, b, c = corner(triangles.corners_m, triangle, 0), corner(triangles.corners_m, triangle, 1), corner(triangles.corners_m, triangle, 2)
    n0, n1, n2 = corner(triangles.normals, triangle, 0), corner(triangles.normals, triangle, 1), corner(triangles.normals, triangle, 2)
    smooth = scaled(unit3(mixed(n0, n1, n2, w)), facing)
    write(out.smooth_normal, i, smooth)
    write(out.normal, i, _mapped_normal(materials, textures, triangles, triangle, smooth, facing, w, uv, footprint))
    # Shadow rays start on the smooth surface that the triangles stand for (Hanika 2021, "Hacking the Shadow Terminator").
    point = mixed(a, b, c, w)
    below_a, below_b = min(0.0, facing * dot(sub(point, a), n0)), min(0.0, facing * dot(sub(point, b), n1))
    below_c = min(0.0, facing * dot(sub(point, c), n2))
    lift = mixed(n0, n1, n2, (w[0] * below_a, w[1] * below_b, w[2] * below_c))
    write(out.shadow_origin, i, sub(point, scaled(lift, facing)))


@compiled
def _mapped_normal(
    materials: PackedMaterials,
    textures: PackedTextures,
    triangles: PackedTriangles,
    triangle: int,
    smooth: Vector,
    facing: float,
    w: Vector,
    uv: Texel,
    footprint: tuple[float, float],
) -> Vector:
    """The smooth normal tilted by the normal map (glTF 2.0, section 3.9.3)."""
    material, tangents = triangles.material[triangle], triangles.tangents
    texture = materials.textures[material, 3]
    along = mixed(corner(tangents, triangle, 0), corner(tangents, triangle, 1), corner(tangents, triangle, 2), w)
    along = sub(along, scaled(smooth, dot(smooth, along)))
    if texture < 0 or dot(along, along) < 1e-20:
        return smooth
    red, green, blue, _ = read_texture(textures, texture, uv, footprint)
    # `smooth` is already on the viewer's side, while the tangent frame belongs to the front.
    tilt = materials.normal_scale[material] * facing
    along = unit3(along)
    across = scaled(cross(smooth, along), tangents[triangle, 0, 3] * facing)
    return unit3(mixed(along, across, smooth, ((2.0 * red - 1.0) * tilt, (2.0 * green - 1.0) * tilt, 2.0 * blue - 1.0)))


@compiled
def _fill_material(
    materials: PackedMaterials,
    textures: PackedTextures,
    material: int,
    base: Vector,
    uv: Texel,
    footprint: tuple[float, float],
    i: int,
    out: Surfaces,
) -> None:
    """Reflection and emission (glTF 2.0, sections 3.9.2 and 3.9.3)."""
    slots = materials.textures
    metallic, roughness = float(materials.metallic_roughness[material, 0]), float(materials.metallic_roughness[material, 1])
    occlusion, is_occluded = 1.0, slots[material, 4] >= 0
    if slots[material, 1] >= 0:
        texel = read_texture(textures, slots[material, 1], uv, footprint)
        metallic, roughness = metallic * texel[2], roughness * texel[1]
        if slots[material, 4] == slots[material, 1]:  # one picture holds both, as most files have it
            occlusion, is_occluded = texel[0], False
    emissive = row(materials.emissive, material)
    if slots[material, 2] >= 0:
        texel = read_texture(textures, slots[material, 2], uv, footprint)
        emissive = (emissive[0] * texel[0], emissive[1] * texel[1], emissive[2] * texel[2])
    if is_occluded:
        occlusion = read_texture(textures, slots[material, 4], uv, footprint)[0]
    out.occlusion[i] = 1.0 + materials.occlusion_strength[material] * (occlusion - 1.0)
    write(out.base, i, base)
    write(out.emissive, i, emissive)
    write(out.diffuse, i, scaled(base, 1.0 - metallic))
    f0 = row(materials.f0, material)
    write(out.f0, i, mixed(f0, base, base, (1.0 - metallic, metallic, 0.0)))
    out.f90[i] = materials.f90[material] + metallic * (1.0 - materials.f90[material])
    out.roughness[i] = -1.0 if materials.unlit[material] else min(max(roughness, 0.0), 1.0)
