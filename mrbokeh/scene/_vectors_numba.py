"""Three-dimensional vectors as tuples, and the decorator of all compiled kernels of this folder."""

from math import sqrt

import numpy as np

from mrbokeh.system.compiled import njit

compiled = njit(cache=True, nogil=True, error_model="numpy", _nrt=False)
"""The kernels allocate nothing and the arrays outlive the call, so counting references is needless; it would be atomic,
several hundred times per shading point, and took two thirds of the time (measured with numba 0.68)."""


Vector = tuple[float, float, float]


@compiled
def dot(a: Vector, b: Vector) -> float:
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@compiled
def cross(a: Vector, b: Vector) -> Vector:
    return (a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0])


@compiled
def sub(a: Vector, b: Vector) -> Vector:
    return (a[0] - b[0], a[1] - b[1], a[2] - b[2])


@compiled
def scaled(a: Vector, s: float) -> Vector:
    return (a[0] * s, a[1] * s, a[2] * s)


@compiled
def unit3(a: Vector) -> Vector:
    """A vector of length 1; a zero vector stays zero."""
    length = sqrt(dot(a, a))
    return scaled(a, 1.0 / length) if length > 0.0 else a


@compiled
def mixed(a: Vector, b: Vector, c: Vector, weights: Vector) -> Vector:
    """Weighted sum of three vectors."""
    w0, w1, w2 = weights
    return (w0 * a[0] + w1 * b[0] + w2 * c[0], w0 * a[1] + w1 * b[1] + w2 * c[1], w0 * a[2] + w1 * b[2] + w2 * c[2])


@compiled
def row(array: np.ndarray, i: int) -> Vector:
    """Return array[i] of an (N, 3) array."""
    return (float(array[i, 0]), float(array[i, 1]), float(array[i, 2]))


@compiled
def corner(array: np.ndarray, triangle: int, number: int) -> Vector:
    """Return array[triangle, number] of a (T, 3, 3 or more) array."""
    return (float(array[triangle, number, 0]), float(array[triangle, number, 1]), float(array[triangle, number, 2]))


@compiled
def write(array: np.ndarray, i: int, a: Vector) -> None:
    """Set array[i] = a of an (N, 3) array."""
    array[i, 0], array[i, 1], array[i, 2] = a[0], a[1], a[2]
