"""Radial distortion with two terms, as structure from motion finds it: from the undistorted pinhole to the picture and back.

Brown-Conrady, COLMAP's RADIAL model (SIMPLE_RADIAL has k2 = 0): with (u, v) the position over the focal length from the principal point
and r^2 = u^2 + v^2, the picture has (u, v) (1 + k1 r^2 + k2 r^4).
"""

import numpy as np
from jaxtyping import Float

from mrbokeh.optics.camera import Camera

Distortion = tuple[float, float]
Positions = Float[np.ndarray, "*batch 2"]

_NEWTON_STEPS = 12
_LARGEST_RADIUS = 4.0  # tan of 76 degrees: beyond what a pinhole with distortion can describe


def distorted_px(camera: Camera, distortion: Distortion, xy_px: Positions) -> Positions:
    """Convert pixel positions of the undistorted pinhole to positions in the picture."""
    plane = _plane(camera, xy_px)
    k1, k2 = distortion
    r2 = np.sum(plane**2, axis=-1, keepdims=True)
    return _pixels(camera, plane * (1.0 + r2 * (k1 + r2 * k2)))


def undistorted_px(camera: Camera, distortion: Distortion, xy_px: Positions) -> Positions:
    """Convert positions in the picture to pixel positions of the undistorted pinhole: the inverse of `distorted_px`.

    NaN beyond the radius at which barrel distortion folds the picture back, since no point is seen there.
    """
    plane = _plane(camera, xy_px)
    if not any(distortion):
        return np.array(xy_px, np.float64)
    radius = np.linalg.norm(plane, axis=-1, keepdims=True)
    true_radius = _undistorted_radius(radius, distortion)
    stretch = np.divide(true_radius, radius, out=np.ones_like(radius), where=radius > 0)
    return _pixels(camera, plane * stretch)


def _undistorted_radius(radius: Float[np.ndarray, "*batch 1"], distortion: Distortion) -> Float[np.ndarray, "*batch 1"]:
    """Solve for the radius by Newton's method between 0 and the fold, where r (1 + k1 r^2 + k2 r^4) grows."""
    k1, k2 = distortion
    fold = _fold_radius(distortion)
    true_radius = np.minimum(radius, 0.99 * fold)
    for _ in range(_NEWTON_STEPS):
        r2 = true_radius**2
        value = true_radius * (1.0 + r2 * (k1 + r2 * k2)) - radius
        slope = 1.0 + r2 * (3.0 * k1 + 5.0 * k2 * r2)
        true_radius = np.clip(true_radius - value / np.maximum(slope, 1e-3), 0.0, fold)
    r2 = true_radius**2
    solved = np.abs(true_radius * (1.0 + r2 * (k1 + r2 * k2)) - radius) < 1e-9 * (1.0 + radius)
    return np.where(solved, true_radius, np.nan)


def _fold_radius(distortion: Distortion) -> float:
    """Return the smallest radius at which d/dr of r (1 + k1 r^2 + k2 r^4) is 0."""
    k1, k2 = distortion
    roots = np.roots([5.0 * k2, 3.0 * k1, 1.0]) if k2 else np.array([-1.0 / (3.0 * k1)])
    squares = [float(root.real) for root in roots if abs(root.imag) < 1e-12 and root.real > 0]
    return min(np.sqrt(min(squares)) if squares else _LARGEST_RADIUS, _LARGEST_RADIUS)


def _plane(camera: Camera, xy_px: Positions) -> Positions:
    return (np.asarray(xy_px, np.float64) - camera.principal_px) / camera.focal_px


def _pixels(camera: Camera, plane: Positions) -> Positions:
    return plane * np.asarray(camera.focal_px) + camera.principal_px
