"""Mesh: triangles with normals, texture coordinates and one material; the tangents that normal maps need."""

from dataclasses import dataclass, field, replace

import numpy as np
from jaxtyping import Float, Float32, Int32

from mrbokeh.scene.material import Material
from mrbokeh.system.errors import InputError


@dataclass(frozen=True, eq=False)
class Mesh:
    """Triangles in world space (metres).

    positions_m: (V, 3) float64. triangles: (T, 3) vertex indices, counter-clockwise when seen from the front.
    normals: (V, 3) unit, for shading.
    uvs: (S, V, 2) S = 0, 1 or 2 sets of texture coordinates.
    tangents: (V, 4) unit tangent and the sign of the bitangent, or None: derived from the texture coordinates where needed.
    colors: (V, 4) linear factors of the base colour, or None for white.
    catches_shadow: the mesh is not drawn; it stands for a real surface of the photograph that receives shadows.
    """

    positions_m: Float[np.ndarray, "vertices 3"]
    triangles: Int32[np.ndarray, "triangles 3"]
    normals: Float32[np.ndarray, "vertices 3"]
    uvs: Float32[np.ndarray, "sets vertices 2"]
    material: Material = field(default_factory=Material)
    tangents: Float32[np.ndarray, "vertices 4"] | None = None
    colors: Float32[np.ndarray, "vertices 4"] | None = None
    name: str = ""
    catches_shadow: bool = False

    def __post_init__(self) -> None:
        count = len(self.positions_m)
        if self.triangles.size and (self.triangles.min() < 0 or self.triangles.max() >= count):
            raise InputError(
                f"mesh {self.name!r}: expected vertex indices from 0 to {count - 1}, "
                f"got {self.triangles.min()} to {self.triangles.max()}: the file or the index list is damaged"
            )
        if not np.isfinite(self.positions_m).all():
            raise InputError(f"mesh {self.name!r}: expected finite positions, got infinite or undefined ones: check the transforms")

    def transformed(self, world_from_mesh: Float[np.ndarray, "4 4"]) -> "Mesh":
        """The same mesh moved, turned, scaled (also unevenly) or mirrored."""
        linear = world_from_mesh[:3, :3]
        mirrored = np.linalg.det(linear) < 0
        tangents = self.tangents
        if tangents is not None:
            along = unit(tangents[:, :3] @ linear.T)
            tangents = np.concatenate([along, tangents[:, 3:] * (-1 if mirrored else 1)], axis=1).astype(np.float32)
        return replace(
            self,
            positions_m=self.positions_m @ linear.T + world_from_mesh[:3, 3],
            normals=unit(self.normals @ np.linalg.inv(linear)).astype(np.float32),
            # Mirroring turns the winding over, and with it what counts as the front.
            triangles=np.ascontiguousarray(self.triangles[:, ::-1]) if mirrored else self.triangles,
            tangents=tangents,
        )


def unit(vectors: Float[np.ndarray, "*batch dim"]) -> Float[np.ndarray, "*batch dim"]:
    """Vectors of length 1; a zero vector stays zero."""
    return vectors / np.maximum(np.linalg.norm(vectors, axis=-1, keepdims=True), 1e-30)


def face_normals(corners_m: Float[np.ndarray, "triangles 3 3"]) -> Float[np.ndarray, "triangles 3"]:
    """Unit normals of triangles given by their corners; degenerate triangles have none (zero)."""
    return unit(np.cross(corners_m[:, 1] - corners_m[:, 0], corners_m[:, 2] - corners_m[:, 0]))


def with_tangents(mesh: Mesh) -> Mesh:
    """Tangents along increasing u, for a mesh that came without.

    As MikkTSpace (Mikkelsen 2008) they are summed over the triangles of a vertex, weighted by the angle there.
    Unlike MikkTSpace vertices are not split where mirrored texture coordinates meet: glTF exporters split them already.
    """
    if mesh.tangents is not None or len(mesh.uvs) == 0:
        return mesh
    corners = mesh.positions_m[mesh.triangles]
    uv = mesh.uvs[0][mesh.triangles].astype(np.float64)
    side_1, side_2 = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    uv_1, uv_2 = uv[:, 1] - uv[:, 0], uv[:, 2] - uv[:, 0]
    area = uv_1[:, 0] * uv_2[:, 1] - uv_2[:, 0] * uv_1[:, 1]
    # glTF's v runs down the picture, while the normal map's green points up: the sign accounts for that.
    handedness = -np.sign(area)
    along_u = unit((side_1 * uv_2[:, 1:] - side_2 * uv_1[:, 1:]) * np.sign(area)[:, None])
    total, sign = np.zeros_like(mesh.positions_m), np.zeros(len(mesh.positions_m))
    for corner in range(3):
        to_next = unit(corners[:, (corner + 1) % 3] - corners[:, corner])
        to_last = unit(corners[:, (corner + 2) % 3] - corners[:, corner])
        angle = np.arccos(np.clip((to_next * to_last).sum(-1), -1, 1))
        np.add.at(total, mesh.triangles[:, corner], along_u * angle[:, None])
        np.add.at(sign, mesh.triangles[:, corner], handedness * angle)
    normals = mesh.normals.astype(np.float64)
    total -= normals * (total * normals).sum(-1, keepdims=True)
    tangents = np.concatenate([unit(total), np.where(sign < 0, -1.0, 1.0)[:, None]], axis=1)
    return replace(mesh, tangents=tangents.astype(np.float32))
