"""Where the surface that a pixel shows is at another moment, for scenes that move as bodies or bend: skins, morphs, single parts."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from embreex.mesh_construction import TriangleMesh
from embreex.rtcore_scene import EmbreeScene
from jaxtyping import Float, Float64, Int64

from mrbokeh.scene.mesh import Mesh
from mrbokeh.scene.rigid_motion import rigid_motion
from mrbokeh.scene.virtual_scene import Scene

_BEFORE = 2.0**-9
"""A ray starts this part of its length before the depth that the layer states, past what is cut out or shines through before it."""
_NEAR = 2.0**-6
"""A surface is taken for the one that is shown where it lies within this part of the stated depth."""


@dataclass(frozen=True, eq=False)
class SurfacePoints:
    """Points of a scene that an eye sees, by which they can be found again when the scene has moved."""

    scene: Scene
    eye_m: Float[np.ndarray, "3"]
    points_m: Float64[np.ndarray, "points 3"]

    def at(self, scene: Scene, every: int = 1) -> Float64[np.ndarray, "some 3"] | None:
        """The same points of the surface, or every so manieth, in another pose of the scene; None where its triangles are others.

        All of it moved as one body is exact; else points follow their triangles, and are NaN where they lie on none, as where a
        layer states the depth of another place in its pixel.
        """
        if scene is self.scene:
            return self.points_m[::every]
        before, after = drawn_meshes(self.scene), drawn_meshes(scene)
        motion = rigid_motion(before, after)
        if motion is not None:
            return self.points_m[::every] @ motion[:3, :3].T + motion[:3, 3]
        return self.following_triangles(after, every)

    def following_triangles(self, after: Sequence[Mesh], every: int = 1) -> Float64[np.ndarray, "some 3"] | None:
        """`at` for what does not move as one body."""
        before = drawn_meshes(self.scene)
        if len(before) != len(after) or any(not np.array_equal(a.triangles, b.triangles) for a, b in zip(before, after, strict=True)):
            return None
        triangle, weights = (values[::every] for values in self._held)
        return np.where((triangle >= 0)[:, None], np.einsum("pc,pck->pk", weights, _corners_m(after)[triangle]), np.nan)

    @cached_property
    def _held(self) -> tuple[Int64[np.ndarray, " points"], Float64[np.ndarray, "points 3"]]:
        """The triangle of each point, -1 for none, and barycentric weights of its corners."""
        corners_m = _corners_m(drawn_meshes(self.scene))
        centre_m = corners_m.reshape(-1, 3).mean(axis=0)
        rays = EmbreeScene(robust=True)
        TriangleMesh(rays, (corners_m - centre_m).astype(np.float32))
        directions = self.points_m - self.eye_m
        starts = self.eye_m - centre_m + (1.0 - _BEFORE) * directions
        hits = rays.run(starts.astype(np.float32), np.ascontiguousarray(directions, np.float32), query="INTERSECT").astype(np.int64)
        weights, length = _met(corners_m[hits], self.eye_m, directions)
        return np.where((hits >= 0) & (np.abs(length - 1.0) < _NEAR), hits, -1), weights


def drawn_meshes(scene: Scene) -> tuple[Mesh, ...]:
    return tuple(mesh for mesh in scene.meshes if len(mesh.triangles) and not mesh.catches_shadow)


def _corners_m(meshes: Sequence[Mesh]) -> Float64[np.ndarray, "triangles 3 3"]:
    return np.concatenate([mesh.positions_m[mesh.triangles] for mesh in meshes])


def _met(
    corners_m: Float64[np.ndarray, "points 3 3"], eye_m: Float[np.ndarray, "3"], directions: Float[np.ndarray, "points 3"]
) -> tuple[Float64[np.ndarray, "points 3"], Float64[np.ndarray, " points"]]:
    """Barycentric weights and the place along each ray where it meets its triangle's plane (Moeller and Trumbore 1997)."""
    side_1, side_2, to_eye = corners_m[:, 1] - corners_m[:, 0], corners_m[:, 2] - corners_m[:, 0], eye_m - corners_m[:, 0]
    p, q = np.cross(directions, side_2), np.cross(to_eye, side_1)
    determinant = np.einsum("pk,pk->p", p, side_1)
    determinant = np.where(determinant == 0.0, np.nan, determinant)
    w1, w2 = np.einsum("pk,pk->p", p, to_eye) / determinant, np.einsum("pk,pk->p", q, directions) / determinant
    return np.stack([1.0 - w1 - w2, w1, w2], axis=-1), np.einsum("pk,pk->p", q, side_2) / determinant
