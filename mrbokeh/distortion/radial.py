"""Models of radial distortion: where a point of the undistorted picture lands, how the picture is stretched there, and the inverse.

All bend a point q = (x, y), counted from the principal point in the model's unit, to q' along the radius, r' = g(r):

    opencv   g = r (1 + k1 r^2 + k2 r^4 + k3 r^6) / (1 + k4 r^2 + k5 r^4 + k6 r^6), and tangentially by p1 and p2 (Brown 1966)
    fisheye  g = a (1 + k1 a^2 + k2 a^4 + k3 a^6 + k4 a^8) with a = atan r (Kannala and Brandt 2006)
    ptlens   g = r (a r^3 + b r^2 + c r + 1 - a - b - c)
    poly3    g = r (1 - k1 + k1 r^2)
    poly5    g = r (1 + k1 r^2 + k2 r^4)

The unit of the first two is the focal length; that of the others, which are lensfun's and Hugin's, is a length in the picture.
The inverse is Newton's method, kept within what the lens sees.

What structure from motion finds is the first with two terms, COLMAP's RADIAL model (SIMPLE_RADIAL has k2 = 0): `distorted_px` and
`undistorted_px` are between the pinhole and the picture by k1 and k2 alone.
"""

from functools import lru_cache

import numpy as np
from jaxtyping import Float

from mrbokeh.optics.camera import Camera

PARAMETERS: dict[str, tuple[str, ...]] = {
    "opencv": ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6"),
    "fisheye": ("k1", "k2", "k3", "k4"),
    "ptlens": ("a", "b", "c"),
    "poly3": ("k1",),
    "poly5": ("k1", "k2"),
}
"""Names of the models and of their parameters; all are 0 where nothing is bent, but for the fisheye."""
IN_LENGTHS = ("ptlens", "poly3", "poly5")

Values = tuple[float, ...]
Radii = Float[np.ndarray, "*batch"]
Points = Float[np.ndarray, "*batch 2"]
Distortion = tuple[float, float]
Positions = Float[np.ndarray, "*batch 2"]

_NEWTON_STEPS = 12


def radial(model: str, values: Values, radius: Radii) -> tuple[Radii, Radii]:
    """Return (g, dg/dr) at radii from 0 on, without the tangential part."""
    if model == "opencv":
        return _rational(values, radius)
    if model == "fisheye":
        angle, (k1, k2, k3, k4) = np.arctan(radius), values
        bent, slope = _odd((1.0, k1, k2, k3, k4), angle)
        return bent, slope / (1.0 + radius**2)
    if model == "ptlens":
        a, b, c = values
        bent = radius * (1.0 - a - b - c + radius * (c + radius * (b + radius * a)))
        return bent, 1.0 - a - b - c + radius * (2.0 * c + radius * (3.0 * b + radius * 4.0 * a))
    return _odd((1.0 - values[0], values[0]) if model == "poly3" else (1.0, *values), radius)


def _odd(terms: Values, radius: Radii) -> tuple[Radii, Radii]:
    """Return r (t0 + t1 r^2 + t2 r^4 ...) and its derivative."""
    r2, value, slope = radius**2, np.zeros_like(radius), np.zeros_like(radius)
    for power, term in reversed(list(enumerate(terms))):
        value, slope = value * r2 + term, slope * r2 + (2 * power + 1) * term
    return radius * value, slope


def _rational(values: Values, radius: Radii) -> tuple[Radii, Radii]:
    k1, k2, _, _, k3, k4, k5, k6 = values
    above, above_slope = _odd((1.0, k1, k2, k3), radius)
    r2 = radius**2
    below = 1.0 + r2 * (k4 + r2 * (k5 + r2 * k6))
    below_slope = radius * (2.0 * k4 + r2 * (4.0 * k5 + r2 * 6.0 * k6))
    return above / below, (above_slope * below - above * below_slope) / below**2


def is_tangential(model: str, values: Values) -> bool:
    return model == "opencv" and (values[2] != 0.0 or values[3] != 0.0)


def bent(model: str, values: Values, points: Points) -> tuple[Points, Float[np.ndarray, "*batch 2 2"]]:
    """Return bent points and the derivatives of their (x, y) by that of the points."""
    radius = np.linalg.norm(points, axis=-1)
    value, slope = radial(model, values, radius)
    at_centre = radius < 1e-12
    safe = np.where(at_centre, 1.0, radius)
    stretch = np.where(at_centre, slope, value / safe)
    along = points / safe[..., None]
    derivative = (slope - stretch)[..., None, None] * along[..., :, None] * along[..., None, :] + stretch[..., None, None] * np.eye(2)
    result = points * stretch[..., None]
    if is_tangential(model, values):
        shift, by = _tangential(values[2], values[3], points)
        return result + shift, derivative + by
    return result, derivative


def _tangential(p1: float, p2: float, points: Points) -> tuple[Points, Float[np.ndarray, "*batch 2 2"]]:
    x, y = points[..., 0], points[..., 1]
    r2 = x * x + y * y
    shift = np.stack([2.0 * p1 * x * y + p2 * (r2 + 2.0 * x * x), p1 * (r2 + 2.0 * y * y) + 2.0 * p2 * x * y], axis=-1)
    across = 2.0 * (p1 * x + p2 * y)
    rows = [[2.0 * p1 * y + 6.0 * p2 * x, across], [across, 6.0 * p1 * y + 2.0 * p2 * x]]
    return shift, np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)


LARGEST_RADIUS = 4.0
"""tan of 76 degrees: beyond what a pinhole can be asked to render."""
_STEPS = 60
_RESIDUAL = 1e-11


@lru_cache(maxsize=256)
def fold_radius(model: str, values: Values) -> float:
    """Return the radius beyond which the picture would run back into itself, so that nothing is seen. At most LARGEST_RADIUS."""
    radii = np.linspace(0.0, LARGEST_RADIUS, 4001)
    value, slope = radial(model, values, radii)
    falls = np.flatnonzero(~((slope > 0.0) & np.isfinite(value) & (value >= 0.0)))
    if not len(falls):
        return LARGEST_RADIUS
    low, high = float(radii[max(falls[0] - 1, 0)]), float(radii[falls[0]])
    for _ in range(_STEPS):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if radial(model, values, np.array([middle]))[1][0] > 0.0 else (low, middle)
    return low


def unbent(model: str, values: Values, points: Points) -> Points:
    """Return the points that `bent` brings to these; NaN if there are none."""
    radius = np.linalg.norm(points, axis=-1)
    before = _radius_before(model, values, radius)
    guess = points * np.divide(before, radius, out=np.ones_like(radius), where=radius > 0.0)[..., None]
    if not is_tangential(model, values):
        return guess
    return _polished(model, values, points, guess)


def _radius_before(model: str, values: Values, radius: Radii) -> Radii:
    """Solve r' = g(r) by Newton's method between 0 and the fold, by bisection if it would leave the bracket."""
    fold = fold_radius(model, values)
    low, high = np.zeros_like(radius), np.full_like(radius, fold)
    found = np.minimum(radius, 0.5 * fold)
    for _ in range(_STEPS):
        value, slope = radial(model, values, found)
        error = value - radius
        if not (np.abs(error) > _RESIDUAL * (1.0 + radius)).any():
            break
        low, high = np.where(error < 0.0, found, low), np.where(error > 0.0, found, high)
        step = found - np.divide(error, slope, out=np.full_like(error, np.inf), where=slope > 0.0)
        found = np.where((step > low) & (step < high), step, 0.5 * (low + high))
    solved = np.abs(radial(model, values, found)[0] - radius) <= 10.0 * _RESIDUAL * (1.0 + radius)
    return np.where(solved, found, np.nan)


def _polished(model: str, values: Values, points: Points, guess: Points) -> Points:
    """Refine the inverse of the radial part to that of the whole model, in two dimensions."""
    # Tangential terms move the edge of what is seen a little: start inside.
    radius = np.linalg.norm(points, axis=-1, keepdims=True)
    inward = points * (0.9 * fold_radius(model, values) / np.maximum(radius, 1e-30))
    found = np.where(np.isnan(guess), inward, guess)
    for _ in range(_STEPS):
        value, derivative = bent(model, values, found)
        error = value - points
        if not (np.abs(error) > _RESIDUAL * (1.0 + radius)).any():
            break
        determinant = derivative[..., 0, 0] * derivative[..., 1, 1] - derivative[..., 0, 1] * derivative[..., 1, 0]
        x = derivative[..., 1, 1] * error[..., 0] - derivative[..., 0, 1] * error[..., 1]
        y = derivative[..., 0, 0] * error[..., 1] - derivative[..., 1, 0] * error[..., 0]
        step = np.stack([x, y], axis=-1) / np.maximum(determinant, 1e-3)[..., None]
        found = found - np.clip(step, -0.5, 0.5)
    value, derivative = bent(model, values, found)
    determinant = derivative[..., 0, 0] * derivative[..., 1, 1] - derivative[..., 0, 1] * derivative[..., 1, 0]
    solved = (np.abs(value - points) <= 10.0 * _RESIDUAL * (1.0 + radius)).all(axis=-1) & (determinant > 0.0)
    return np.where(solved[..., None], found, np.nan)


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
    return min(np.sqrt(min(squares)) if squares else LARGEST_RADIUS, LARGEST_RADIUS)


def _plane(camera: Camera, xy_px: Positions) -> Positions:
    return (np.asarray(xy_px, np.float64) - camera.principal_px) / camera.focal_px


def _pixels(camera: Camera, plane: Positions) -> Positions:
    return plane * np.asarray(camera.focal_px) + camera.principal_px
