"""Triangles, materials and textures on the graphics device.

Triangles are in the order in which they are drawn: solid, cut out, blended. All texels of a scene's textures, with their coarser
levels, lie in one long array.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Bool, Float16, Float32, Float64, Int, UInt32

from mrbokeh.scene.material import Texture
from mrbokeh.scene.mesh import Mesh
from mrbokeh.scene.packed_scene import (
    PackedMaterials,
    PackedTextures,
    PackedTriangles,
    packed_materials,
    packed_textures,
    packed_triangles,
    textures_of,
)
from mrbokeh.scene.wgpu.device import Gpu

_ROW = 2048
"""TEXEL_ROW of geometry.wgsl: the long array is a picture of that width in layers, as buffers are too small for it."""
_MOST_TEXELS = 1 << 26
"""512 MB; beyond it the largest textures lose their finest level."""
_ROW_OF_TABLE = 16


@dataclass(frozen=True, eq=False)
class TexelPool:
    """Textures that a scene uses. textures keeps them alive, for they are known by identity."""

    textures: tuple[Texture, ...]
    table: Any
    texels: Any


def texel_pool(gpu: Gpu, textures: Sequence[Texture]) -> TexelPool:
    """Upload textures as half floats, the levels of each one after the other."""
    table = np.zeros((max(len(textures), 1), _ROW_OF_TABLE), np.uint32)
    parts, start = [], 0
    skips = _skipped_levels(textures)
    for row, texture, skip in zip(table, textures, skips, strict=False):
        levels = packed_textures([texture])
        first = int(levels.level_start[skip])
        row[:] = _described(levels, skip, start)
        parts.append(levels.texels[first:].astype(np.float16))
        start += len(parts[-1])
    texels = np.concatenate(parts) if parts else np.zeros((1, 4), np.float16)
    return TexelPool(tuple(textures), gpu.buffer(table), _uploaded(gpu, texels))


def _described(levels: PackedTextures, skip: int, start: int) -> UInt32[np.ndarray, "16"]:
    """A row of the table: struct Texture of geometry.wgsl."""
    height, width = levels.level_size[skip]
    row = np.zeros(_ROW_OF_TABLE, np.uint32)
    row[:7] = start, width, height, len(levels.level_size) - skip, *levels.wrap[0], levels.uv_set[0]
    maps = np.zeros((2, 4), np.float32)
    maps[:, :3] = levels.texture_from_uv[0]
    row[8:] = maps.ravel().view(np.uint32)
    return row


def _skipped_levels(textures: Sequence[Texture]) -> list[int]:
    """Return how many fine levels of each texture to leave out so that all fit."""
    skips = [0] * len(textures)
    sizes = [texture.texels.shape[0] * texture.texels.shape[1] * 4 / 3 for texture in textures]
    while sum(size / 4**skip for size, skip in zip(sizes, skips, strict=True)) > _MOST_TEXELS:
        largest = max(range(len(textures)), key=lambda index: sizes[index] / 4 ** skips[index])
        skips[largest] += 1
    return skips


def _uploaded(gpu: Gpu, texels: Float16[np.ndarray, "texels 4"]) -> Any:
    rows = -(-len(texels) // _ROW)
    height = min(rows, _ROW)
    layers = -(-rows // height)
    texture = gpu.texture((_ROW, height, layers), "rgba16float", usage="TEXTURE_BINDING|COPY_DST")
    for layer in range(layers):
        part = texels[layer * height * _ROW : (layer + 1) * height * _ROW]
        part_rows = -(-len(part) // _ROW)
        padded = np.zeros((part_rows * _ROW, 4), np.float16)
        padded[: len(part)] = part
        gpu.device.queue.write_texture(
            {"texture": texture, "origin": (0, 0, layer)},
            padded,
            {"bytes_per_row": _ROW * 8, "rows_per_image": part_rows},
            (_ROW, part_rows, 1),
        )
    return texture.create_view(dimension="2d-array")


@dataclass(frozen=True, eq=False)
class GpuGeometry:
    """Triangles relative to centre_m, and what the shaders need to read their materials.

    ends: the first triangle behind the solid ones, behind the cut out ones (MASK) and behind all; within each part clusters
        follow each other, cluster_ends[part] says where they end.
    box_m: (8, 3) corners of the box around the triangles, relative to centre_m; cluster_boxes_m of each cluster (one or two).
    """

    centre_m: Float64[np.ndarray, "3"]
    reach_m: float
    corners_m: Float64[np.ndarray, "triangles 3 3"]
    box_m: Float64[np.ndarray, "8 3"]
    ends: tuple[int, int, int]
    cluster_ends: Int[np.ndarray, "parts clusters"]
    cluster_boxes_m: tuple[Float64[np.ndarray, "8 3"], ...]
    triangles: Any
    materials: Any
    pool: TexelPool

    @property
    def has_blended(self) -> bool:
        return self.ends[2] > self.ends[1]

    @property
    def has_see_through(self) -> bool:
        return self.ends[2] > self.ends[0]


def uploaded(gpu: Gpu, meshes: Sequence[Mesh], pool_of: Callable[[tuple[Texture, ...]], TexelPool]) -> GpuGeometry:
    """Meshes with at least one triangle on the device. pool_of: gives the texels of textures, kept by the caller from pose to pose."""
    points = np.concatenate([mesh.positions_m[mesh.triangles].reshape(-1, 3) for mesh in meshes])
    centre_m = (points.min(0) + points.max(0)) / 2
    is_large = _large(meshes)
    triangles, materials, textures = _packed(meshes, centre_m, is_large)
    part = materials.alpha_mode[triangles.material] * 2 + is_large[triangles.mesh]
    cluster_ends = np.cumsum(np.bincount(part, minlength=6)).reshape(3, 2)
    solid, cut, blended = cluster_ends[:, 1].tolist()
    clusters = [corners for large in (False, True) if len(corners := triangles.corners_m[is_large[triangles.mesh] == large])]
    return GpuGeometry(
        centre_m=centre_m,
        reach_m=float(np.abs(triangles.corners_m).max()),
        corners_m=triangles.corners_m,
        box_m=_box(triangles.corners_m),
        ends=(solid, cut, blended),
        cluster_ends=cluster_ends,
        cluster_boxes_m=tuple(_box(corners) for corners in clusters),
        triangles=gpu.buffer(_triangle_rows(triangles)),
        materials=gpu.buffer(_material_rows(materials)),
        pool=pool_of(textures),
    )


def _box(corners_m: Float64[np.ndarray, "triangles 3 3"]) -> Float64[np.ndarray, "8 3"]:
    choice = np.stack(np.meshgrid(*[[0, 1]] * 3, indexing="ij"), axis=-1).reshape(-1, 3)
    return np.where(choice == 1, corners_m.max((0, 1)), corners_m.min((0, 1)))


def _large(meshes: Sequence[Mesh]) -> Bool[np.ndarray, " meshes"]:
    """Meshes much larger than the others together, such as a floor: with one shadow map for all a toy on it would have few texels.

    The others are as many of the smallest as fit into a box of a quarter of the whole one's diagonal; False for all where none do.
    """
    boxes = np.stack([[points.min(0), points.max(0)] for points in (mesh.positions_m[mesh.triangles.ravel()] for mesh in meshes)])
    order = np.argsort(np.linalg.norm(boxes[:, 1] - boxes[:, 0], axis=-1))
    low, high = np.minimum.accumulate(boxes[order, 0]), np.maximum.accumulate(boxes[order, 1])
    diagonal = np.linalg.norm(high - low, axis=-1)
    small = int(np.count_nonzero(diagonal < diagonal[-1] / 4))
    is_large = np.zeros(len(meshes), np.bool_)
    is_large[order[small:]] = small > 0
    return is_large


def _packed(
    meshes: Sequence[Mesh], centre_m: Float64[np.ndarray, "3"], is_large: Bool[np.ndarray, " meshes"]
) -> tuple[PackedTriangles, PackedMaterials, tuple[Texture, ...]]:
    """Pack like `packed`, sorted by alpha mode and cluster, without the textures' texels, whose levels take long to make."""
    materials = list({id(mesh.material): mesh.material for mesh in meshes}.values())
    textures = list({id(t): t for material in materials for t in textures_of(material) if t is not None}.values())
    number = {id(material): index for index, material in enumerate(materials)}
    parts = [packed_triangles(mesh, centre_m, number[id(mesh.material)], index) for index, mesh in enumerate(meshes)]
    rows = packed_materials(materials, textures)
    columns = PackedTriangles(*(np.concatenate(column) for column in zip(*parts, strict=True)))
    order = np.argsort(rows.alpha_mode[columns.material] * 2 + is_large[columns.mesh], kind="stable")
    return PackedTriangles(*(np.ascontiguousarray(column[order]) for column in columns)), rows, tuple(textures)


def _triangle_rows(triangles: PackedTriangles) -> Float32[np.ndarray, "triangles 15 4"]:
    """PER_TRIANGLE rows of geometry.wgsl; the fourth numbers hold the material, the mesh and the densities of the texture."""
    rows = np.zeros((len(triangles.mesh), 15, 4), np.float32)
    rows[:, 0:3, :3], rows[:, 3:6, :3] = triangles.corners_m, triangles.normals
    rows[:, 0, 3], rows[:, 1, 3] = triangles.material, triangles.mesh
    rows[:, 3:5, 3] = triangles.uv_density
    rows[:, 6:9], rows[:, 9:12], rows[:, 12:15] = triangles.tangents, triangles.uvs, triangles.colors
    return rows


def _material_rows(materials: PackedMaterials) -> Float32[np.ndarray, "materials 24"]:
    """Return rows of struct Material of geometry.wgsl."""
    floats = np.concatenate(
        [
            materials.base_color,
            *(materials.emissive, materials.normal_scale[:, None]),
            *(materials.f0, materials.f90[:, None]),
            *(materials.metallic_roughness, materials.occlusion_strength[:, None], materials.alpha_cutoff[:, None]),
        ],
        axis=1,
    )
    base, *others = materials.textures.T
    whole = np.stack([materials.alpha_mode, materials.double_sided, materials.unlit, base, *others], axis=1).astype(np.int32)
    return np.concatenate([floats, whole.view(np.float32)], axis=1)
