"""Paths over the picture of the surfaces that are seen in the middle of the shutter's time.

Surfaces are followed in scenes that move as rigid bodies or bend: skins, morphs, single parts.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import cv2
import numpy as np
from embreex.mesh_construction import TriangleMesh
from embreex.rtcore_scene import EmbreeScene
from jaxtyping import Bool, Float, Float32, Float64, Int64

from mrbokeh.images.layer import Layer
from mrbokeh.layering.pixel_box import Box, lit_box
from mrbokeh.optics.camera import Camera
from mrbokeh.scene.mesh import Mesh, rigid_motion
from mrbokeh.scene.moving_layers.filmed_scene import FilmedScene
from mrbokeh.scene.virtual_scene import Scene

_BEFORE = 2.0**-9
"""A ray starts this part of its length before the depth that the layer states, past what is cut out or shines through before it."""
_NEAR = 2.0**-6
"""A surface is taken for the one that is shown where it lies within this part of the stated depth."""

FRACTIONS = (-0.5, -0.25, 0.0, 0.25, 0.5)
"""Moments of the time span at which paths are looked at, from its middle."""
_MOST = 99.9
"""Per cent of the pixels that decide: surfaces are found again at nearly all, but at an edge one may belong to another."""
_LOOKED_AT = 20000
"""Pixels, evenly over what is visible, at which more than the ends of paths is looked at."""
Places = Float64[np.ndarray, "points 2"]


@dataclass(frozen=True, eq=False)
class SurfacePoints:
    """Points of a scene that an eye sees, by which they can be found again when the scene has moved."""

    scene: Scene
    eye_m: Float[np.ndarray, "3"]
    points_m: Float64[np.ndarray, "points 3"]

    def at(self, scene: Scene, every: int = 1) -> Float64[np.ndarray, "some 3"] | None:
        """Return the same points of the surface, or every n-th, in another pose of the scene; None if its triangles are others.

        A rigid motion of the whole is exact; else points follow their triangles, and are NaN where they lie on none, for instance where
        a layer states the depth of another place in its pixel.
        """
        if scene is self.scene:
            return self.points_m[::every]
        before, after = self.scene.drawn_meshes, scene.drawn_meshes
        motion = rigid_motion(before, after)
        if motion is not None:
            return self.points_m[::every] @ motion[:3, :3].T + motion[:3, 3]
        return self.following_triangles(after, every)

    def following_triangles(self, after: Sequence[Mesh], every: int = 1) -> Float64[np.ndarray, "some 3"] | None:
        """`at` for what does not move as one body."""
        before = self.scene.drawn_meshes
        if len(before) != len(after) or any(not np.array_equal(a.triangles, b.triangles) for a, b in zip(before, after, strict=True)):
            return None
        triangle, weights = (values[::every] for values in self._held)
        return np.where((triangle >= 0)[:, None], np.einsum("pc,pck->pk", weights, _corners_m(after)[triangle]), np.nan)

    @cached_property
    def _held(self) -> tuple[Int64[np.ndarray, " points"], Float64[np.ndarray, "points 3"]]:
        """The triangle of each point, -1 for none, and barycentric weights of its corners."""
        corners_m = _corners_m(self.scene.drawn_meshes)
        centre_m = corners_m.reshape(-1, 3).mean(axis=0)
        rays = EmbreeScene(robust=True)
        TriangleMesh(rays, (corners_m - centre_m).astype(np.float32))
        directions = self.points_m - self.eye_m
        starts = self.eye_m - centre_m + (1.0 - _BEFORE) * directions
        hits = rays.run(starts.astype(np.float32), np.ascontiguousarray(directions, np.float32), query="INTERSECT").astype(np.int64)
        weights, length = _met(corners_m[hits], self.eye_m, directions)
        return np.where((hits >= 0) & (np.abs(length - 1.0) < _NEAR), hits, -1), weights


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


@dataclass(frozen=True)
class Paths:
    """Motion of a picture over a time span.

    motion_px: (h, w, 2) over a box of the picture, from the beginning to the end of the span, at the places of its middle. bend_px:
    largest deviation from even motion between the ends, by curving or by uneven speed. length_px: length of the longest path, piece by
    piece.
    """

    box: Box
    motion_px: Float32[np.ndarray, "height width 2"]
    bend_px: float
    length_px: float


def paths_of(layer: Layer, filmed: FilmedScene, middle_s: float, span_s: float) -> Paths | None:
    """Paths of what a layer, rendered in the middle of a time span, shows; None where they cannot be found.

    The layer's depth is taken to lie in the middle of the pixel. Where the surface is not found again, and around what is
    visible, a pixel moves like the nearest one that was found.
    """
    box, camera = lit_box(layer), filmed.camera_at(middle_s)
    depth_m = layer.depth_m[box.where]
    visible = np.isfinite(depth_m) & (layer.alpha[box.where] > 0)
    rows, columns = np.nonzero(visible)
    centres_px = np.stack([columns + box.left + 0.5, rows + box.top + 0.5], axis=-1)
    points_m = camera.unproject(centres_px, depth_m[visible].astype(np.float64))
    points = SurfacePoints(filmed.scene_at(middle_s), camera.world_from_camera[:3, 3], points_m)
    ends = [_seen_px(points, filmed, middle_s + fraction * span_s, 1) for fraction in (FRACTIONS[0], FRACTIONS[-1])]
    every = max(1, len(centres_px) // _LOOKED_AT)
    between = [_seen_px(points, filmed, middle_s + fraction * span_s, every) for fraction in (FRACTIONS[1], FRACTIONS[3])]
    first, last, second, fourth = (*ends, *between)
    if first is None or last is None or second is None or fourth is None:
        return None
    motion_px = _dense((last - first).astype(np.float32), visible)
    course = np.stack([first[::every], second, centres_px[::every], fourth, last[::every]])
    course = course[:, np.isfinite(course).all(axis=(0, -1))]
    return None if motion_px is None or not course.size else Paths(box, motion_px, _bend_px(course), _length_px(course))


def _seen_px(points: SurfacePoints, filmed: FilmedScene, moment_s: float, every: int) -> Places | None:
    """Return the places at which points are seen at a moment; NaN behind the camera and for points that were not found again."""
    moved_m, camera = points.at(filmed.scene_at(moment_s), every), filmed.camera_at(moment_s)
    return None if moved_m is None else _projected(camera, moved_m)


def _projected(camera: Camera, points_m: Float64[np.ndarray, "points 3"]) -> Places:
    in_front = points_m @ camera.camera_from_world[2, :3] + camera.camera_from_world[2, 3] > 0.0
    return camera.project(points_m if in_front.all() else np.where(in_front[:, None], points_m, np.nan))[0]


def _dense(
    motion_px: Float32[np.ndarray, "points 2"], visible: Bool[np.ndarray, "height width"]
) -> Float32[np.ndarray, "height width 2"] | None:
    """Every pixel without motion gets that of the nearest with it; None where nothing has."""
    known = np.isfinite(motion_px).all(axis=1)
    if not known.any():
        return None
    missing = np.ones(visible.shape, np.uint8)
    missing[visible] = ~known
    _, label = cv2.distanceTransformWithLabels(missing, cv2.DIST_L2, 5, labelType=cv2.DIST_LABEL_PIXEL)
    by_label = np.zeros((int(label.max()) + 1, 2), np.float32)
    by_label[label[missing == 0]] = motion_px[known]
    return by_label[label]


def _bend_px(course: Float64[np.ndarray, "moments points 2"]) -> float:
    first, last = course[0], course[-1]
    even = (first + (fraction + 0.5) * (last - first) for fraction in FRACTIONS)
    away = [np.linalg.norm(place - expected, axis=-1) for place, expected in zip(course, even, strict=True)]
    return float(np.percentile(np.max(away, axis=0), _MOST))


def _length_px(course: Float64[np.ndarray, "moments points 2"]) -> float:
    return float(np.percentile(np.linalg.norm(np.diff(course, axis=0), axis=-1).sum(axis=0), _MOST))
