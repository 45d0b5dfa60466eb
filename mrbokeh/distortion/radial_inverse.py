"""The inverse of distortion models: Newton's method, kept within what the lens sees."""

from functools import lru_cache

import numpy as np

from mrbokeh.distortion.models import Points, Radii, Values, bent, is_tangential, radial

LARGEST_RADIUS = 4.0
"""tan of 76 degrees: beyond what a pinhole can be asked to render."""
_STEPS = 60
_RESIDUAL = 1e-11


@lru_cache(maxsize=256)
def fold_radius(model: str, values: Values) -> float:
    """The radius from which on the picture would run back into itself: nothing beyond it is seen. At most LARGEST_RADIUS."""
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
    """The points that `bent` brings to these; NaN where there are none."""
    radius = np.linalg.norm(points, axis=-1)
    before = _radius_before(model, values, radius)
    guess = points * np.divide(before, radius, out=np.ones_like(radius), where=radius > 0.0)[..., None]
    if not is_tangential(model, values):
        return guess
    return _polished(model, values, points, guess)


def _radius_before(model: str, values: Values, radius: Radii) -> Radii:
    """Newton's method on r' = g(r) between 0 and the fold, by bisection where it would leave the bracket."""
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
    """From the inverse of the radial part to that of all, in two dimensions."""
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
