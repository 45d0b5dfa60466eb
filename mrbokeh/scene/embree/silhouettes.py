"""Silhouette edges of a scene's triangles: where, from a given eye, a surface ends, however thin it is in the picture."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Float64, Int64

from mrbokeh.scene.embree._silhouettes_numba import mark_segments


@dataclass(frozen=True, eq=False)
class MeshEdges:
    """Every edge of the triangles once: its two ends, and the two triangles that share it.

    ends_m: (E, 2, 3). faces: (E, 2) triangle indices; the second is -1 at the border of an open surface.
    face_planes: (T, 4) normal and offset of each triangle's plane.
    """

    ends_m: Float64[np.ndarray, "edges 2 3"]
    faces: Int64[np.ndarray, "edges 2"]
    face_planes: Float64[np.ndarray, "triangles 4"]

    def seen_from(self, eye_m: Float[np.ndarray, "3"]) -> Float64[np.ndarray, "silhouettes 2 3"]:
        """Edges between a triangle that faces the eye and one that does not, or nothing."""
        faces_eye = self.face_planes[:, :3] @ eye_m > self.face_planes[:, 3]
        is_outline = (self.faces[:, 1] < 0) | (faces_eye[self.faces[:, 0]] != faces_eye[self.faces[:, 1]])
        return self.ends_m[is_outline]


def mesh_edges(corners_m: Float64[np.ndarray, "triangles 3 3"]) -> MeshEdges:
    """Find the edges of triangles given by their corners; corners at exactly the same place are one vertex."""
    count = len(corners_m)
    flat = np.ascontiguousarray(corners_m.reshape(-1, 3).astype(np.float32) + np.float32(0.0))  # + 0 makes -0 and 0 the same bytes
    _, vertex = np.unique(flat.view(np.dtype((np.void, 12))).ravel(), return_inverse=True)
    vertex = vertex.reshape(count, 3).astype(np.int64)
    start, end = vertex.ravel(), np.roll(vertex, -1, axis=1).ravel()
    key = np.minimum(start, end) * 3 * count + np.maximum(start, end)
    order = np.argsort(key, kind="stable")
    sorted_key = key[order]
    is_first = np.concatenate([[True], sorted_key[1:] != sorted_key[:-1]])
    first = np.flatnonzero(is_first)
    shares = np.diff(np.append(first, len(order)))
    faces = np.stack([order[first] // 3, order[np.minimum(first + 1, len(order) - 1)] // 3], axis=1)
    faces[shares != 2, 1] = -1  # one triangle only, or more than two: always a candidate
    corner = order[first]
    ends = np.stack([corners_m.reshape(-1, 3)[corner], np.roll(corners_m, -1, axis=1).reshape(-1, 3)[corner]], axis=1)
    normals = np.cross(corners_m[:, 1] - corners_m[:, 0], corners_m[:, 2] - corners_m[:, 0])
    planes = np.concatenate([normals, (normals * corners_m[:, 0]).sum(-1, keepdims=True)], axis=1)
    return MeshEdges(ends, faces, planes)


def silhouette_pixels(
    ends_in_camera_m: Float64[np.ndarray, "silhouettes 2 3"],
    focal_px: tuple[float, float],
    principal_px: tuple[float, float],
    depth_m: Float64[np.ndarray, "height width"],
) -> Bool[np.ndarray, "height width"]:
    """Pixels that a visible silhouette crosses. depth_m: what the pixel centres see, to leave hidden silhouettes out."""
    farthest = np.pad(depth_m, 1, mode="edge")
    farthest = np.maximum(np.maximum(farthest[:-2], farthest[1:-1]), farthest[2:])
    farthest = np.ascontiguousarray(np.maximum(np.maximum(farthest[:, :-2], farthest[:, 1:-1]), farthest[:, 2:]))
    marked = np.zeros(depth_m.shape, np.bool_)
    mark_segments(np.ascontiguousarray(ends_in_camera_m), np.array([*focal_px, *principal_px], np.float64), farthest, marked)
    return marked
