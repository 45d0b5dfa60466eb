"""Pixels that need more than one sample, and the places of those samples.

Samples are needed at borders between surfaces and along silhouettes, the edges where a surface ends as seen from the eye, however thin
it is in the picture.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Float32, Float64, Int32, Int64

from mrbokeh.scene.embree._marking_numba import mark_edges, mark_segments

_DEPTH_STEP = 0.02
"""Relative distance from the neighbour's tangent plane beyond which two pixels do not show one surface."""
_LARGEST_TURN_RAD = 0.5
_SHARE_STEP = 0.02
_SIXTEENTHS = (
    *((1, 2), (4, 3), (8, 0), (12, 1), (2, 6), (6, 7), (9, 4), (14, 5)),
    *((3, 10), (7, 11), (11, 8), (13, 9), (0, 12), (5, 15), (10, 14), (15, 13)),
)
"""One sample in each cell of 4x4 and in each of sixteen rows and columns. Of such patterns this one came out of an annealing
for the least error of coverage over straight edges of all directions: 0.031 RMS, and 0.018 for upright and level edges,
where the centres of 4x4 cells have 0.031 and 0.072."""
_FOUR_EIGHTHS = ((2, 0), (6, 2), (0, 4), (4, 6))
"""The same in 2x2 cells and four rows and columns: the turned grid of graphics cards. Error of coverage 0.093 RMS."""
SAMPLE_COUNTS = (4, 16)


def sample_offsets_px(count: int) -> Float[np.ndarray, "samples 2"]:
    """Points of a pixel, (x, y) from 0 to 1. count: one of SAMPLE_COUNTS."""
    return (np.array(_FOUR_EIGHTHS) + 1.0) / 8 if count == 4 else (np.array(_SIXTEENTHS) + 0.5) / 16


def edge_pixels(
    mesh: Int32[np.ndarray, "height width"],
    alpha: Float32[np.ndarray, "height width"],
    depth_m: Float[np.ndarray, "height width"],
    normal: Float32[np.ndarray, "height width 3"],
    lit: Float32[np.ndarray, "height width"],
    directions: Float[np.ndarray, "height width 3"],
) -> Bool[np.ndarray, "height width"]:
    """Pixels beside which another mesh, coverage, normal, distance or a shadow begins; both sides are marked.

    lit: share of the lights that is not in shadow, so that shadow borders are smooth too.
    directions: of the pixels' rays, 1 long along the optical axis; normals in the same axes.
    """
    edges = np.zeros(mesh.shape, np.bool_)
    flat = (np.ascontiguousarray(values).ravel() for values in (mesh, alpha, depth_m))
    vectors = (np.ascontiguousarray(values).reshape(-1, 3) for values in (normal, directions))
    steps = np.array([_SHARE_STEP, _DEPTH_STEP, np.cos(_LARGEST_TURN_RAD)])
    normals, rays = vectors
    mark_edges(*flat, normals, np.ascontiguousarray(lit).ravel(), rays, mesh.shape[1], steps, edges.ravel())
    return edges


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
