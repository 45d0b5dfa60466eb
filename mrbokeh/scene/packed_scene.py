"""A Scene as flat arrays, the form in which compiled kernels read it."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import cv2
import numpy as np
from jaxtyping import Bool, Float, Float32, Float64, Int32

from mrbokeh.scene.material import Material, Texture
from mrbokeh.scene.mesh import Mesh, with_tangents

OPAQUE, MASK, BLEND = 0, 1, 2
REPEAT, CLAMP, MIRROR = 0, 1, 2
_ALPHA_MODES = {"OPAQUE": OPAQUE, "MASK": MASK, "BLEND": BLEND}
_WRAPS = {"repeat": REPEAT, "clamp": CLAMP, "mirror": MIRROR}


class PackedTriangles(NamedTuple):
    """Triangles of all meshes; positions are relative to `centre_m` and rounded to float32 as the ray tracer sees them."""

    corners_m: Float64[np.ndarray, "triangles 3 3"]
    normals: Float32[np.ndarray, "triangles 3 3"]
    tangents: Float32[np.ndarray, "triangles 3 4"]
    uvs: Float32[np.ndarray, "triangles 3 4"]  # set 0, set 1
    uv_density: Float32[np.ndarray, "triangles 2"]  # sqrt(area in texture / area in space), per set
    colors: Float32[np.ndarray, "triangles 3 4"]
    material: Int32[np.ndarray, " triangles"]
    mesh: Int32[np.ndarray, " triangles"]


class PackedMaterials(NamedTuple):
    """One row per material; textures are indices into PackedTextures or -1."""

    base_color: Float32[np.ndarray, "materials 4"]
    metallic_roughness: Float32[np.ndarray, "materials 2"]
    emissive: Float32[np.ndarray, "materials 3"]
    f0: Float32[np.ndarray, "materials 3"]
    f90: Float32[np.ndarray, " materials"]
    normal_scale: Float32[np.ndarray, " materials"]
    occlusion_strength: Float32[np.ndarray, " materials"]
    alpha_mode: Int32[np.ndarray, " materials"]
    alpha_cutoff: Float32[np.ndarray, " materials"]
    double_sided: Bool[np.ndarray, " materials"]
    unlit: Bool[np.ndarray, " materials"]
    textures: Int32[np.ndarray, "materials 5"]  # base colour, metallic-roughness, emissive, normal, occlusion


class PackedTextures(NamedTuple):
    """Textures with their coarser levels, one after the other."""

    texels: Float32[np.ndarray, "texels 4"]
    level_start: Int32[np.ndarray, " levels"]
    level_size: Int32[np.ndarray, "levels 2"]  # height, width
    first_level: Int32[np.ndarray, " textures_plus_one"]
    wrap: Int32[np.ndarray, "textures 2"]
    uv_set: Int32[np.ndarray, " textures"]
    texture_from_uv: Float32[np.ndarray, "textures 2 3"]


@dataclass(frozen=True, eq=False)
class KeptTextures:
    """Packed textures and what they were packed from, in that order."""

    sources: tuple[Texture, ...]
    packed: PackedTextures


def packed(
    meshes: Sequence[Mesh], centre_m: Float[np.ndarray, "3"], kept: KeptTextures | None = None
) -> tuple[PackedTriangles, PackedMaterials, KeptTextures]:
    """Meshes, materials and textures as arrays; shared materials and textures are stored once.

    kept: what another call packed; it is handed back where the textures are the very same.
    """
    materials = list({id(mesh.material): mesh.material for mesh in meshes}.values())
    used = (texture for material in materials for texture in textures_of(material) if texture is not None)
    textures = list({_reads(texture): texture for texture in used}.values())
    number = {id(material): index for index, material in enumerate(materials)}
    parts = [packed_triangles(mesh, centre_m, number[id(mesh.material)], index) for index, mesh in enumerate(meshes)]
    triangles = PackedTriangles(*(np.ascontiguousarray(np.concatenate(column)) for column in zip(*parts, strict=True)))
    if kept is None or [_reads(texture) for texture in kept.sources] != [_reads(texture) for texture in textures]:
        kept = KeptTextures(tuple(textures), packed_textures(textures))
    return triangles, packed_materials(materials, textures), kept


def textures_of(material: Material) -> tuple[Texture | None, ...]:
    return (
        material.base_color_texture,
        material.metallic_roughness_texture,
        material.emissive_texture,
        material.normal_texture,
        material.occlusion_texture,
    )


def _reads(texture: Texture) -> tuple[object, ...]:
    """Return the key of a texture's values: equal keys are one texture, such as roughness and occlusion in one picture."""
    return id(texture.texels), texture.wrap, texture.uv_set, np.asarray(texture.texture_from_uv, np.float64).tobytes()


def packed_triangles(mesh: Mesh, centre_m: Float[np.ndarray, "3"], material: int, index: int) -> PackedTriangles:
    if mesh.material.normal_texture is not None:
        mesh = with_tangents(mesh)
    corner, count = mesh.triangles, len(mesh.triangles)
    corners_m = (mesh.positions_m - centre_m).astype(np.float32).astype(np.float64)[corner]
    uvs = np.zeros((count, 3, 4), np.float32)
    for number, uv in enumerate(mesh.uvs):
        uvs[..., 2 * number : 2 * number + 2] = uv[corner]
    space = np.linalg.norm(np.cross(corners_m[:, 1] - corners_m[:, 0], corners_m[:, 2] - corners_m[:, 0]), axis=-1)
    sides = (uvs[:, 1:] - uvs[:, :1]).reshape(count, 2, 2, 2).astype(np.float64)  # triangle, side, set, (u, v)
    texture = np.abs(sides[:, 0, :, 0] * sides[:, 1, :, 1] - sides[:, 0, :, 1] * sides[:, 1, :, 0])
    zeros, ones = np.zeros((count, 3, 4), np.float32), np.ones((count, 3, 4), np.float32)
    return PackedTriangles(
        corners_m=corners_m,
        normals=mesh.normals[corner],
        tangents=zeros if mesh.tangents is None else mesh.tangents[corner],
        uvs=uvs,
        uv_density=np.sqrt(texture / np.maximum(space, 1e-30)[:, None]).astype(np.float32),
        colors=ones if mesh.colors is None else mesh.colors[corner],
        material=np.full(count, material, np.int32),
        mesh=np.full(count, index, np.int32),
    )


def packed_materials(materials: list[Material], textures: list[Texture]) -> PackedMaterials:
    number = {_reads(texture): index for index, texture in enumerate(textures)}

    def column(values: list[object], dtype: type) -> np.ndarray:
        return np.array(values, dtype)

    return PackedMaterials(
        base_color=column([m.base_color for m in materials], np.float32),
        metallic_roughness=column([(m.metallic, m.roughness) for m in materials], np.float32),
        emissive=column([m.emissive for m in materials], np.float32),
        f0=column([m.dielectric_f0 for m in materials], np.float32),
        f90=column([m.specular for m in materials], np.float32),
        normal_scale=column([m.normal_scale for m in materials], np.float32),
        occlusion_strength=column([m.occlusion_strength for m in materials], np.float32),
        alpha_mode=column([_ALPHA_MODES[m.alpha_mode] for m in materials], np.int32),
        alpha_cutoff=column([m.alpha_cutoff for m in materials], np.float32),
        double_sided=column([m.double_sided for m in materials], np.bool_),
        unlit=column([m.unlit for m in materials], np.bool_),
        textures=column([[-1 if texture is None else number[_reads(texture)] for texture in textures_of(m)] for m in materials], np.int32),
    )


def packed_textures(textures: list[Texture]) -> PackedTextures:
    texels, sizes, first_level = [np.zeros((0, 4), np.float32)], [], [0]
    for texture in textures:
        for level in _levels(texture.texels):
            texels.append(level.reshape(-1, 4))
            sizes.append(level.shape[:2])
        first_level.append(len(sizes))
    counts = [len(level) for level in texels]
    return PackedTextures(
        texels=np.concatenate(texels),
        level_start=np.cumsum(counts)[:-1].astype(np.int32),
        level_size=np.array(sizes, np.int32).reshape(-1, 2),
        first_level=np.array(first_level, np.int32),
        wrap=np.array([[_WRAPS[way] for way in texture.wrap] for texture in textures], np.int32).reshape(-1, 2),
        uv_set=np.array([texture.uv_set for texture in textures], np.int32),
        texture_from_uv=np.array([texture.texture_from_uv for texture in textures], np.float32).reshape(-1, 2, 3),
    )


def _levels(texels: Float32[np.ndarray, "height width channels"]) -> list[Float32[np.ndarray, "_ _ 4"]]:
    """The texture, halved again and again by area averages down to one texel."""
    height, width, channels = texels.shape
    level = texels if channels == 4 else np.concatenate([texels, np.ones((height, width, 1), np.float32)], axis=2)
    levels = [level]
    while max(level.shape[:2]) > 1:
        half = (max(level.shape[1] // 2, 1), max(level.shape[0] // 2, 1))
        level = cv2.resize(level, half, interpolation=cv2.INTER_AREA)
        levels.append(level)
    return levels
