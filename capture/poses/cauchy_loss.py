"""Cauchy's loss ln(1 + r^2) in fits, where a few wrong matches must not outweigh the many right ones; and priors beside it."""

import numpy as np
from jaxtyping import Float

CAUCHY_95 = 2.385
"""Standard deviations at which residuals count as 1: 95 % efficient for normal errors (Holland and Welsch 1977)."""

_NORMAL_MAD = 1.4826
_LEAST_DEVIATION = 1e-6
_LARGEST_EXPONENT = 100.0


def deviation(residuals: Float[np.ndarray, " residuals"]) -> float:
    """Standard deviation about 0 by the median absolute residual; never 0."""
    return max(_NORMAL_MAD * float(np.median(np.abs(residuals))), _LEAST_DEVIATION) if residuals.size else _LEAST_DEVIATION


def squared_under_cauchy(residuals: Float[np.ndarray, "*shape"]) -> Float[np.ndarray, "*shape"]:
    """What Cauchy's loss turns into r^2: a prior is meant as it is stated, however far the data pull."""
    return np.sign(residuals) * np.sqrt(np.expm1(np.minimum(residuals**2, _LARGEST_EXPONENT)))


def squared_under_cauchy_slope(residuals: Float[np.ndarray, "*shape"]) -> Float[np.ndarray, "*shape"]:
    """Derivative of `squared_under_cauchy`."""
    square = np.minimum(residuals**2, _LARGEST_EXPONENT)
    size = np.sqrt(square)
    return np.where(size < 1e-6, 1.0, size * np.exp(square) / np.sqrt(np.expm1(np.maximum(square, 1e-12))))
