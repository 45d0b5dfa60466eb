"""Viewpoints of a plane sweep: picture as structure, camera, the numbers that the loops take, and which neighbours tell most."""

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Float, Float32

from mrbokeh.distortion.radial import Distortion, undistorted_px
from mrbokeh.optics.camera import Camera

Plane = Float32[np.ndarray, "height width"]

BRIGHTEST = 1.2
_BAND_ROWS = 64
_LUMINANCE = np.array([0.2126, 0.7152, 0.0722], np.float32)
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


def neighbour_vote(points: Float[np.ndarray, "points 3"], first: Float[np.ndarray, "3"], second: Float[np.ndarray, "3"]) -> float:
    """Return how much two cameras at these centres tell about the depth of points that both see.

    Each point gives a vote that grows with the angle under which the two cameras see it up to 8 degrees and falls beyond (as COLMAP
    and MVSNet choose their sources): less is too little parallax, more changes what is seen.
    """
    to_first, to_second = first - points, second - points
    lengths = np.linalg.norm(to_first, axis=1) * np.linalg.norm(to_second, axis=1)
    angle = np.arccos(np.clip((to_first * to_second).sum(axis=1) / np.maximum(lengths, 1e-12), -1.0, 1.0))
    ratio = angle / _BEST_ANGLE_RAD
    return float(np.minimum(ratio, 1.0 / np.maximum(ratio, 1e-9)).sum())
