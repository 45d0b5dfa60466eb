"""What a plane sweep knows of one viewpoint: its picture as structure, its camera, and the numbers that the loops take."""

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Float, Float32

from capture.poses.distortion import Distortion, undistorted_px
from mrbokeh.optics.camera import Camera

Plane = Float32[np.ndarray, "height width"]

BRIGHTEST = 1.2
_BAND_ROWS = 64
_LUMINANCE = np.array([0.2126, 0.7152, 0.0722], np.float32)


@dataclass(frozen=True, eq=False)
class SweepView:
    """structure (H, W): what is compared between views, see `structure_of`; camera, distortion: see `SparseView`, in metres."""

    structure: Plane
    camera: Camera
    distortion: Distortion = (0.0, 0.0)

    def resized(self, width_px: int, height_px: int) -> "SweepView":
        """The same view with fewer pixels, each the mean of what it covers."""
        smaller = cv2.resize(self.structure, (width_px, height_px), interpolation=cv2.INTER_AREA)
        return SweepView(smaller, self.camera.resized(width_px, height_px), self.distortion)


def structure_of(rgb: Float32[np.ndarray, "height width 3"]) -> Plane:
    """Scene-linear RGB to the square root of luminance, in which shot noise is even; over-range lights are cut at `BRIGHTEST`."""
    return np.sqrt(np.clip(rgb @ _LUMINANCE, 0.0, BRIGHTEST))


def rays_of(view: SweepView) -> Float32[np.ndarray, "height width 2"]:
    """Through the centre of each pixel, the point at depth 1 m in camera axes; NaN where distortion folds the picture."""
    camera = view.camera
    rays = np.empty((camera.height_px, camera.width_px, 2), np.float32)
    for first in range(0, camera.height_px, _BAND_ROWS):  # in double precision, so in bands
        rows = np.arange(first, min(first + _BAND_ROWS, camera.height_px)) + 0.5
        xy_px = np.stack(np.meshgrid(np.arange(camera.width_px) + 0.5, rows), axis=-1)
        pinhole = undistorted_px(camera, view.distortion, xy_px)
        rays[first : first + _BAND_ROWS] = (pinhole - camera.principal_px) / np.asarray(camera.focal_px)
    return rays


def neighbour_from_reference(reference: Camera, neighbour: Camera) -> Float[np.ndarray, "4 4"]:
    """Rigid transform of points in the reference camera's axes into the neighbour's, metres."""
    return neighbour.camera_from_world @ reference.world_from_camera


def packed_view(reference: SweepView, neighbour: SweepView) -> Float32[np.ndarray, " 18"]:
    """Rotation (9, by rows), translation (3), focal length (2), principal point in samples (2), k1, k2 for the loops.

    A point on the ray (x, y, 1) at dioptre d is (x, y, 1) / d; times d it is R (x, y, 1) + d t in the neighbour: finite at infinity.
    Samples count from the centre of the first pixel, hence the half pixel less.
    """
    pose = neighbour_from_reference(reference.camera, neighbour.camera)
    camera = neighbour.camera
    principal = (camera.principal_px[0] - 0.5, camera.principal_px[1] - 0.5)
    return np.array([*pose[:3, :3].ravel(), *pose[:3, 3], *camera.focal_px, *principal, *neighbour.distortion], np.float32)
