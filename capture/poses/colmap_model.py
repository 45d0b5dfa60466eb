"""A reconstruction of COLMAP as a SparseModel."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from capture.poses.colmap_job import ColmapPicture
from capture.poses.distortion import Distortion
from capture.poses.sparse_model import SparseModel, SparseView
from mrbokeh.optics.camera import Camera


def sparse_model_of(reconstruction: Any, pictures: Sequence[ColmapPicture]) -> SparseModel:
    """Views in the order of the pictures; those that COLMAP could not place are left_out."""
    images = {image.name: image for image in reconstruction.images.values() if image.has_pose}
    placed = [each for each in pictures if each.file in images]
    views = tuple(_view(each.name, images[each.file]) for each in placed)
    index_of_image = {images[each.file].image_id: index for index, each in enumerate(placed)}
    points = [reconstruction.points3D[key] for key in sorted(reconstruction.points3D)]
    observations, xy_px = [], []
    for index, point in enumerate(points):
        for element in point.track.elements:
            observations.append((index_of_image[element.image_id], index))
            xy_px.append(reconstruction.images[element.image_id].points2D[element.point2D_idx].xy)
    return SparseModel(
        views,
        points=np.array([point.xyz for point in points], np.float64).reshape(-1, 3),
        errors_px=np.array([point.error for point in points], np.float64),
        observations=np.array(observations, np.int64).reshape(-1, 2),
        observed_xy_px=np.array(xy_px, np.float64).reshape(-1, 2),
        left_out=tuple(each.name for each in pictures if each.file not in images),
    )


def _view(name: str, image: Any) -> SparseView:
    pose = np.eye(4)
    pose[:3] = image.cam_from_world().matrix()
    camera, distortion = _camera(image.camera, pose)
    return SparseView(name, camera, distortion)


def _camera(camera: Any, pose: np.ndarray) -> tuple[Camera, Distortion]:
    """SIMPLE_PINHOLE has f, cx, cy; SIMPLE_RADIAL also k; RADIAL k1, k2. COLMAP's pixel centres lie where ours do."""
    focal, cx, cy, *terms = (float(value) for value in camera.params)
    k1, k2 = (*terms, 0.0, 0.0)[:2]
    return Camera(camera.width, camera.height, (focal, focal), (cx, cy), pose), (k1, k2)
