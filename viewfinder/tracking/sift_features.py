"""SIFT features (Lowe 2004) of a grey picture as RootSIFT (Arandjelovic and Zisserman 2012), at places in our convention."""

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Float32, Float64, UInt8

_LENGTH = 128

Grey = UInt8[np.ndarray, "height width"]


@dataclass(frozen=True)
class Features:
    """xy_px: the centre of the first pixel is at (0.5, 0.5). descriptors: of length 1."""

    xy_px: Float64[np.ndarray, "features 2"]
    descriptors: Float32[np.ndarray, "features 128"]


def find_features(grey: Grey, most: int) -> Features:
    """The strongest ones."""
    keypoints, descriptors = cv2.SIFT.create(nfeatures=most).detectAndCompute(grey, None)
    if descriptors is None:
        return Features(np.zeros((0, 2)), np.zeros((0, _LENGTH), np.float32))
    xy_px = np.array([point.pt for point in keypoints], np.float64) + 0.5
    # Hellinger's distance: roots of descriptors whose sum is 1.
    roots = np.sqrt(descriptors / np.maximum(descriptors.sum(axis=1, keepdims=True), 1e-9))
    return Features(xy_px, roots.astype(np.float32))
