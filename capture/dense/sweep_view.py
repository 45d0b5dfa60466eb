"""Viewpoints of a plane sweep: picture as structure, camera, and the numbers that the loops take; a scene's pictures and neighbours."""

from dataclasses import dataclass
from functools import lru_cache

import cv2
import numpy as np
from jaxtyping import Float, Float32

from capture.merging.second_pass import first_pass_path
from capture.poses.sparse_model import Distortion, SparseModel, SparseView, undistorted_px
from mrbokeh.images.camera_rgb import read_camera_rgb
from mrbokeh.optics.camera import Camera
from mrbokeh.stacks.focal_stack import FocalStack

Plane = Float32[np.ndarray, "height width"]

BRIGHTEST = 1.2
_BAND_ROWS = 64
_LUMINANCE = np.array([0.2126, 0.7152, 0.0722], np.float32)
_HELD = 8
_BEST_ANGLE_RAD = np.deg2rad(8.0)


@dataclass(frozen=True, eq=False)
class SweepView:
    """One viewpoint. structure (H, W): compared between views, see `structure_of`; camera, distortion: see `SparseView`, in metres."""

    structure: Plane
    camera: Camera
    distortion: Distortion = (0.0, 0.0)

    def resized(self, width_px: int, height_px: int) -> "SweepView":
        """Return the view with fewer pixels, each the mean of its area."""
        smaller = cv2.resize(self.structure, (width_px, height_px), interpolation=cv2.INTER_AREA)
        return SweepView(smaller, self.camera.resized(width_px, height_px), self.distortion)


def structure_of(rgb: Float32[np.ndarray, "height width 3"]) -> Plane:
    """Return the square root of scene-linear luminance, in which shot noise is uniform; highlights are clipped at `BRIGHTEST`."""
    return np.sqrt(np.clip(rgb @ _LUMINANCE, 0.0, BRIGHTEST))


def rays_of(view: SweepView) -> Float32[np.ndarray, "height width 2"]:
    """Return the point at depth 1 m through the centre of each pixel in camera axes; NaN where distortion folds the picture."""
    camera = view.camera
    rays = np.empty((camera.height_px, camera.width_px, 2), np.float32)
    for first in range(0, camera.height_px, _BAND_ROWS):  # in double precision, so in bands
        rows = np.arange(first, min(first + _BAND_ROWS, camera.height_px)) + 0.5
        xy_px = np.stack(np.meshgrid(np.arange(camera.width_px) + 0.5, rows), axis=-1)
        pinhole = undistorted_px(camera, view.distortion, xy_px)
        rays[first : first + _BAND_ROWS] = (pinhole - camera.principal_px) / np.asarray(camera.focal_px)
    return rays


def neighbour_from_reference(reference: Camera, neighbour: Camera) -> Float[np.ndarray, "4 4"]:
    """Return the rigid transform from the reference camera's axes to the neighbour's, metres."""
    return neighbour.camera_from_world @ reference.world_from_camera


def packed_view(reference: SweepView, neighbour: SweepView) -> Float32[np.ndarray, " 18"]:
    """Return rotation (9, by rows), translation (3), focal length (2), principal point in samples (2), k1, k2 for the loops.

    A point on the ray (x, y, 1) at dioptre d is (x, y, 1) / d; times d it is R (x, y, 1) + d t in the neighbour: finite at infinity.
    Samples count from the centre of the first pixel, hence the half pixel less.
    """
    pose = neighbour_from_reference(reference.camera, neighbour.camera)
    camera = neighbour.camera
    principal = (camera.principal_px[0] - 0.5, camera.principal_px[1] - 0.5)
    return np.array([*pose[:3, :3].ravel(), *pose[:3, 3], *camera.focal_px, *principal, *neighbour.distortion], np.float32)


class FirstPictures:
    """First-pass pictures of a scene's stacks, by the name of their view. A few structures are cached."""

    def __init__(self, stacks: dict[str, FocalStack]) -> None:
        self.stacks = stacks
        self.view = lru_cache(_HELD)(self._view)

    def rgb(self, name: str) -> Float32[np.ndarray, "height width 3"]:
        """Return linear Rec.709."""
        stack = self.stacks[name]
        return stack.to_rec709(read_camera_rgb(first_pass_path(stack, stack.all_in_focus_path)))

    def _view(self, view_name: str) -> Float32[np.ndarray, "height width"]:
        return structure_of(self.rgb(view_name))


def nearest_views(model: SparseModel, name: str, count: int) -> list[SparseView]:
    """Return at most `count` other views that tell most about the depth of one, best first.

    Each common point gives a vote that grows with the angle under which the two cameras see it up to 8 degrees and falls
    beyond (as COLMAP and MVSNet choose their sources): less is too little parallax, more changes what is seen.
    """
    reference, mine = model.view(name), model.points_of(name)
    votes = []
    for view in model.views:
        common = model.points[np.intersect1d(mine, model.points_of(view))] if view.name != name else np.zeros((0, 3))
        votes.append(float(_vote(common, reference, view).sum()))
    order = sorted(range(len(votes)), key=lambda index: -votes[index])
    return [model.views[index] for index in order[:count] if votes[index] > 0.0]


def _vote(points: np.ndarray, first: SparseView, second: SparseView) -> np.ndarray:
    to_first, to_second = first.centre - points, second.centre - points
    lengths = np.linalg.norm(to_first, axis=1) * np.linalg.norm(to_second, axis=1)
    angle = np.arccos(np.clip((to_first * to_second).sum(axis=1) / np.maximum(lengths, 1e-12), -1.0, 1.0))
    ratio = angle / _BEST_ANGLE_RAD
    return np.minimum(ratio, 1.0 / np.maximum(ratio, 1e-9))
