"""Triangles and materials on the graphics device, in the order in which they are drawn: solid, cut out, blended."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Bool, Float32, Float64, Int

from mrbokeh.scene.material import Texture
from mrbokeh.scene.mesh import Mesh
from mrbokeh.scene.packed_scene import PackedMaterials, PackedTriangles, packed_materials, packed_triangles, textures_of
from mrbokeh.scene.wgpu.device import Gpu
from mrbokeh.scene.wgpu.textures import TexelPool


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
    """As `packed`, sorted by alpha mode and cluster, and without the textures' texels, as making their levels takes long."""
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
    """struct Material of geometry.wgsl."""
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
