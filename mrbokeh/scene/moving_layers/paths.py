"""Paths over the picture of the surfaces that are seen in the middle of the shutter's time."""

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float32, Float64

from mrbokeh.images.layer import Layer
from mrbokeh.layering.pixel_box import Box, lit_box
from mrbokeh.optics.camera import Camera
from mrbokeh.scene.moving_layers.filmed_scene import FilmedScene
from mrbokeh.scene.surface_motion import SurfacePoints

FRACTIONS = (-0.5, -0.25, 0.0, 0.25, 0.5)
"""Moments of the time span at which paths are looked at, from its middle."""
_MOST = 99.9
"""Per cent of the pixels that decide: surfaces are found again at nearly all, but at an edge one may belong to another."""
_LOOKED_AT = 20000
"""Pixels, evenly over what is visible, at which more than the ends of paths is looked at."""

Places = Float64[np.ndarray, "points 2"]


@dataclass(frozen=True)
class Paths:
    """motion_px: (h, w, 2) over a box of the picture, from the beginning to the end of the span, at the places of its middle.

    bend_px: how far paths run beside the even motion between their ends, by curving or by going unevenly. length_px: of the
    longest path, piece by piece.
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
    """Where points are seen at a moment, NaN behind the camera and where they were not found again."""
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
