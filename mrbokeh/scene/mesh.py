"""Mesh: triangles with normals, texture coordinates and one material; tangents for normal maps, simple shapes, rigid motions."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from jaxtyping import Float, Float32, Float64, Int32

from mrbokeh.scene.material import Material, Triple
from mrbokeh.system.errors import InputError

_SAMPLES = 256
_PLACE_TOLERANCE = 2.0**-24
"""Of the extent: half of what rounding to float32, the precision of the ray tracer, changes at most."""
_NORMAL_TOLERANCE = 1e-5


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
        """Return the mesh moved, turned, scaled (also unevenly) or mirrored."""
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


def sphere(centre_m: Triple, radius_m: float, material: Material, rows: int = 64) -> Mesh:
    """A sphere of `rows` rings and twice as many meridians, vertices on the sphere (faces therefore a little inside).

    The largest distance between face and sphere is about radius * (pi / rows)**2 / 4.
    """
    polar, longitude = np.meshgrid(np.linspace(0, np.pi, rows + 1), np.linspace(0, 2 * np.pi, 2 * rows + 1), indexing="ij")
    normals = np.stack([np.sin(polar) * np.sin(longitude), -np.cos(polar), -np.sin(polar) * np.cos(longitude)], axis=-1).reshape(-1, 3)
    uvs = np.stack([longitude / (2 * np.pi), polar / np.pi], axis=-1).reshape(1, -1, 2)
    row, column = (index.ravel() for index in np.meshgrid(np.arange(rows), np.arange(2 * rows), indexing="ij"))
    corner = row * (2 * rows + 1) + column
    below = corner + 2 * rows + 1
    quads = np.stack([corner, below + 1, corner + 1, corner, below, below + 1], axis=-1).reshape(-1, 3)
    degenerate = np.stack([row == 0, row == rows - 1], axis=-1).ravel()
    return Mesh(
        positions_m=np.asarray(centre_m) + radius_m * normals,
        triangles=quads[~degenerate].astype(np.int32),
        normals=normals.astype(np.float32),
        uvs=uvs.astype(np.float32),
        material=material,
        name="sphere",
    )


def rectangle(
    corner_m: Triple,
    side_u_m: Triple,
    side_v_m: Triple,
    material: Material,
    catches_shadow: bool = False,
) -> Mesh:
    """The parallelogram corner + u * side_u + v * side_v, u and v from 0 to 1, which are also its texture coordinates.

    Its front is where side_v x side_u points: with u to the right and v down as seen, it faces the viewer.
    """
    corner, side_u, side_v = np.asarray(corner_m, float), np.asarray(side_u_m, float), np.asarray(side_v_m, float)
    uvs = np.array([[0, 0], [1, 0], [1, 1], [0, 1]], np.float32)
    normal = np.cross(side_v, side_u)
    return Mesh(
        positions_m=corner + uvs[:, :1] * side_u + uvs[:, 1:] * side_v,
        triangles=np.array([[0, 2, 1], [0, 3, 2]], np.int32),
        normals=np.repeat((normal / np.linalg.norm(normal))[None], 4, axis=0).astype(np.float32),
        uvs=uvs[None],
        material=material,
        name="rectangle",
        catches_shadow=catches_shadow,
    )


def shadow_catcher(height_y_m: float, centre_xz_m: tuple[float, float], half_size_m: float) -> Mesh:
    """A level square at y = height_y_m (up is -y) that is not drawn but receives shadows."""
    x, z = centre_xz_m
    return rectangle(
        (x - half_size_m, height_y_m, z + half_size_m), (2 * half_size_m, 0, 0), (0, 0, -2 * half_size_m), Material(), catches_shadow=True
    )


def rigid_motion(before: Sequence[Mesh], after: Sequence[Mesh]) -> Float64[np.ndarray, "4 4"] | None:
    """Return the (4, 4) after_from_before, or None if anything but a common motion without scaling changed.

    Meshes count as the same if they share triangles, texture coordinates, colours and material as objects, as `Mesh.transformed` leaves
    them; then every vertex, normal and tangent is checked.
    """
    if len(before) != len(after) or not all(map(_shares_all_but_place, before, after)):
        return None
    if all(one is other for one, other in zip(before, after, strict=True)):
        return np.eye(4)
    motion = _fitted(_sampled(before), _sampled(after))
    return motion if all(_is_moved(one, other, motion) for one, other in zip(before, after, strict=True)) else None


def _shares_all_but_place(one: Mesh, other: Mesh) -> bool:
    shared = one.triangles is other.triangles and one.uvs is other.uvs and one.colors is other.colors and one.material is other.material
    same_tangents = (one.tangents is None) == (other.tangents is None)
    return shared and same_tangents and len(one.positions_m) == len(other.positions_m)


def _sampled(meshes: Sequence[Mesh]) -> Float64[np.ndarray, "points 3"]:
    points_m = [mesh.positions_m[:: max(1, len(mesh.positions_m) * len(meshes) // _SAMPLES)] for mesh in meshes]
    return np.concatenate(points_m).astype(np.float64)


def _fitted(before_m: Float64[np.ndarray, "points 3"], after_m: Float64[np.ndarray, "points 3"]) -> Float64[np.ndarray, "4 4"]:
    """The rotation and shift of least squares (Kabsch 1976)."""
    middle_before, middle_after = before_m.mean(0), after_m.mean(0)
    left, _, right = np.linalg.svd((after_m - middle_after).T @ (before_m - middle_before))
    keeps_hands = np.diag([1.0, 1.0, np.sign(np.linalg.det(left @ right))])
    motion = np.eye(4)
    motion[:3, :3] = left @ keeps_hands @ right
    motion[:3, 3] = middle_after - motion[:3, :3] @ middle_before
    return motion


def _is_moved(one: Mesh, other: Mesh, motion: Float64[np.ndarray, "4 4"]) -> bool:
    """Return whether `other` is `one` under this motion, in all that shading uses."""
    turn = motion[:3, :3]
    tolerance_m = _PLACE_TOLERANCE * float(np.ptp(one.positions_m, axis=0).max(initial=0.0))
    if np.abs(one.positions_m @ turn.T + motion[:3, 3] - other.positions_m).max(initial=0.0) > tolerance_m:
        return False
    if not _is_turned(one.normals, other.normals, turn):
        return False
    if one.tangents is None or other.tangents is None:
        return True
    return _is_turned(one.tangents[:, :3], other.tangents[:, :3], turn) and np.array_equal(one.tangents[:, 3], other.tangents[:, 3])


def _is_turned(one: Float32[np.ndarray, "n 3"], other: Float32[np.ndarray, "n 3"], turn: Float64[np.ndarray, "3 3"]) -> bool:
    return float(np.abs(one @ turn.T.astype(np.float32) - other).max(initial=0.0)) < _NORMAL_TOLERANCE
