"""Finds a camera in a map: SIFT of a frame matched with what the map's points look like, verified by pycolmap's absolute pose."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float32, Float64, Int64

from mrbokeh.optics.camera import Camera
from mrbokeh.tracking.charuco.detector import NO_CORNERS, Corners, Grey
from viewfinder.flow.frames import Pose
from viewfinder.tracking.map_pose import pose_in_map
from viewfinder.tracking.sift_features import find_features
from viewfinder.tracking.sparse_map import SparseMap

_FEATURES = 1200
_AT_ONCE = 256
_LOWES_RATIO = 0.85


@dataclass(frozen=True)
class Localisation:
    """camera_from_map: metres. points: those of the map that were found, and where. matches: how many there were before verification."""

    camera_from_map: Pose
    points: Corners
    matches: int


class MapLocaliser:
    """`detect` fits in a DetectionThread. camera: intrinsics, which follow the size of the frame; may be replaced at any time."""

    def __init__(self, sparse_map: SparseMap, camera: Camera) -> None:
        self.map, self.camera = sparse_map, camera

    def detect(self, grey: Grey) -> Corners:
        found = self.localise(grey)
        return NO_CORNERS if found is None else found.points

    def localise(self, grey: Grey) -> Localisation | None:
        """None where too few points agree on a pose."""
        camera = self.camera.resized(grey.shape[1], grey.shape[0])
        features = find_features(grey, _FEATURES)
        if not len(features.xy_px):
            return None
        feature, point = matches(features.descriptors, self.map)
        xy_px = features.xy_px[feature]
        fit = pose_in_map(self.map.points_m[point], xy_px, camera)
        if fit is None:
            return None
        return Localisation(fit.camera_from_world, Corners(point, xy_px).only(fit.inliers), len(feature))


Numbers = Int64[np.ndarray, " matches"]


def matches(descriptors: Float32[np.ndarray, "features 128"], sparse_map: SparseMap) -> tuple[Numbers, Numbers]:
    """(features, points): each feature's nearest point, by its nearest look, where the next point is clearly farther (Lowe's ratio);
    of several features that claim one point the nearest.
    """
    starts = np.flatnonzero(np.diff(sparse_map.point_of, prepend=-1))
    if len(starts) < 2:
        return np.zeros(0, np.int64), np.zeros(0, np.int64)
    nearest, distances = _nearest(descriptors, sparse_map, starts)
    clear = np.flatnonzero(distances[:, 0] < _LOWES_RATIO * distances[:, 1])
    by_distance = clear[np.argsort(distances[clear, 0], kind="stable")]
    points, first = np.unique(nearest[by_distance], return_index=True)
    return by_distance[first].astype(np.int64), points.astype(np.int64)


def _nearest(
    descriptors: Float32[np.ndarray, "features 128"], sparse_map: SparseMap, starts: Int64[np.ndarray, " points"]
) -> tuple[Int64[np.ndarray, " features"], Float64[np.ndarray, "features 2"]]:
    """(nearest point, distances to it and to the next point); vectors of length 1 are the nearer the larger their product."""
    nearest, products = [], []
    for first in range(0, len(descriptors), _AT_ONCE):
        alike = np.maximum.reduceat(descriptors[first : first + _AT_ONCE] @ sparse_map.descriptors.T, starts, axis=1)
        two = np.argpartition(-alike, 1, axis=1)[:, :2]
        largest = np.take_along_axis(alike, two, axis=1)
        nearest.append(two[np.arange(len(two)), largest.argmax(axis=1)])
        products.append(-np.sort(-largest, axis=1))
    distances = np.sqrt(np.maximum(2.0 - 2.0 * np.concatenate(products).astype(np.float64), 0.0))
    return np.concatenate(nearest).astype(np.int64), distances
