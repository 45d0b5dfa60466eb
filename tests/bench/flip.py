"""FLIP, how different two pictures look when one flips between them (Andersson et al. 2020, "FLIP: A Difference Evaluator for Alternating
Images", Proc. ACM CGIT 3(2)), for displayed pictures, written from the paper.

Both are seen at a distance: filtered by the eye's sensitivity to contrast in opponent colours, compared in a colour space whose distances
are those that are seen, and told apart the more, the more their edges and points differ. No weights are learned or needed.
"""

import cv2
import numpy as np
from jaxtyping import Float

PIXELS_PER_DEGREE = 67.0  # the paper's: 0.7 m from a display of 3840 px on 0.7 m
_COLOUR_POWER, _FEATURE_POWER = 0.7, 0.5
_KNEE, _KNEE_VALUE = 0.4, 0.95  # of the largest colour difference; what it becomes
_FEATURE_DEGREES = 0.082
_SENSITIVITY = (((1.0, 0.0047), (0.0, 1e-5)), ((1.0, 0.0053), (0.0, 1e-5)), ((34.1, 0.04), (13.5, 0.025)))
"""(a, b) of two Gaussians, for the opponent channels: achromatic, red-green, blue-yellow."""
_XYZ_FROM_RGB = np.array([[0.4124564, 0.3575761, 0.1804375], [0.2126729, 0.7151522, 0.0721750], [0.0193339, 0.1191920, 0.9503041]])
_WHITE = _XYZ_FROM_RGB.sum(axis=1)

Picture = Float[np.ndarray, "height width 3"]
Plane = Float[np.ndarray, "height width"]


def flip(reference: Picture, test: Picture, pixels_per_degree: float = PIXELS_PER_DEGREE) -> Plane:
    """Return the difference of each pixel, 0 to 1, of pictures in linear Rec.709, shown with white at 1."""
    opponents = [_opponent(np.clip(each.astype(np.float64), 0.0, 1.0)) for each in (reference, test)]
    colour = _colour_difference(*(_seen(each, pixels_per_degree) for each in opponents))
    one, other = (_features((each[..., 0] + 16.0) / 116.0, pixels_per_degree) for each in opponents)
    feature = (np.abs(one - other).max(axis=0) / np.sqrt(2.0)) ** _FEATURE_POWER
    return np.asarray(colour ** (1.0 - feature))


def _opponent(rgb: Picture) -> Picture:
    """Return the channels YyCxCz: linear ones, whose filtering mixes light."""
    x, y, z = np.moveaxis(rgb @ _XYZ_FROM_RGB.T / _WHITE, -1, 0)
    return np.stack([116.0 * y - 16.0, 500.0 * (x - y), 200.0 * (y - z)], axis=-1)


def _seen(opponent: Picture, pixels_per_degree: float) -> Picture:
    """Return what the eye resolves, in L*a*b* with less colour where it is dark (Hunt)."""
    widest = max(b for pair in _SENSITIVITY for _, b in pair)
    radius = int(np.ceil(3.0 * np.sqrt(widest / (2.0 * np.pi**2)) * pixels_per_degree))
    along = (np.arange(-radius, radius + 1) / pixels_per_degree) ** 2
    square = along + along[:, None]
    planes = []
    for channel, pair in enumerate(_SENSITIVITY):
        kernel = sum(a * np.sqrt(np.pi / b) * np.exp(-(np.pi**2) * square / b) for a, b in pair)
        planes.append(_filtered(opponent[..., channel], kernel / np.sum(kernel)))
    y = (planes[0] + 16.0) / 116.0
    rgb = np.clip(np.stack([planes[1] / 500.0 + y, y, y - planes[2] / 200.0], axis=-1) * _WHITE @ np.linalg.inv(_XYZ_FROM_RGB).T, 0.0, 1.0)
    return _hunt_lab(rgb)


def _hunt_lab(rgb: Picture) -> Picture:
    share = rgb @ _XYZ_FROM_RGB.T / _WHITE
    delta = 6.0 / 29.0
    x, y, z = np.moveaxis(np.where(share > delta**3, np.cbrt(share), share / (3.0 * delta**2) + 4.0 / 29.0), -1, 0)
    light = 116.0 * y - 16.0
    return np.stack([light, 0.01 * light * 500.0 * (x - y), 0.01 * light * 200.0 * (y - z)], axis=-1)


def _far_apart(one: Picture, other: Picture) -> Plane:
    """Return HyAB, city block of lightness and colour, compressed."""
    apart = one - other
    return np.asarray((np.abs(apart[..., 0]) + np.hypot(apart[..., 1], apart[..., 2])) ** _COLOUR_POWER)


def _colour_difference(one: Picture, other: Picture) -> Plane:
    green, blue = (_hunt_lab(np.array([[each]])) for each in ((0.0, 1.0, 0.0), (0.0, 0.0, 1.0)))
    largest = float(_far_apart(green, blue)[0, 0])
    knee = _KNEE * largest
    apart = _far_apart(one, other)
    high = _KNEE_VALUE + (apart - knee) / (largest - knee) * (1.0 - _KNEE_VALUE)
    return np.minimum(np.where(apart < knee, apart * _KNEE_VALUE / knee, high), 1.0)


def _features(light: Plane, pixels_per_degree: float) -> Float[np.ndarray, "2 height width"]:
    """Return the strength of edges and of points."""
    spread = 0.5 * _FEATURE_DEGREES * pixels_per_degree
    along = np.arange(-int(np.ceil(3.0 * spread)), int(np.ceil(3.0 * spread)) + 1)
    bell = np.exp(-0.5 * (along / spread) ** 2)
    found = []
    for profile in (-along * bell, (along**2 / spread**2 - 1.0) * bell):
        kernel = profile * bell[:, None]
        kernel = np.where(kernel > 0.0, kernel / kernel[kernel > 0.0].sum(), -kernel / kernel[kernel < 0.0].sum())
        found.append(np.hypot(_filtered(light, kernel), _filtered(light, kernel.T)))
    return np.stack(found)


def _filtered(plane: Plane, kernel: np.ndarray) -> Plane:
    return np.asarray(cv2.filter2D(plane, cv2.CV_64F, np.ascontiguousarray(kernel), borderType=cv2.BORDER_REPLICATE))
