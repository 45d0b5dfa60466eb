"""Cauchy's loss ln(1 + r^2) for robust fits, in which a few wrong matches do not outweigh many right ones; priors beside it."""

import numpy as np
from jaxtyping import Float

CAUCHY_95 = 2.385
"""Standard deviations at which residuals count as 1: 95 % efficient for normal errors (Holland and Welsch 1977)."""

MEDIAN_OF_RAYLEIGH = 1.1774
"""Median length of an error whose two parts are normal with a deviation of 1."""

_NORMAL_MAD = 1.4826
_LEAST_DEVIATION = 1e-6
_LARGEST_EXPONENT = 100.0


def deviation(residuals: Float[np.ndarray, " residuals"]) -> float:
    """Return the standard deviation about 0 from the median absolute residual; never 0."""
    return max(_NORMAL_MAD * float(np.median(np.abs(residuals))), _LEAST_DEVIATION) if residuals.size else _LEAST_DEVIATION


def squared_under_cauchy(residuals: Float[np.ndarray, "*shape"]) -> Float[np.ndarray, "*shape"]:
    """Return the residual that Cauchy's loss turns into r^2, so that a prior keeps its stated strength however far the data pull."""
    return np.sign(residuals) * np.sqrt(np.expm1(np.minimum(residuals**2, _LARGEST_EXPONENT)))


def squared_under_cauchy_slope(residuals: Float[np.ndarray, "*shape"]) -> Float[np.ndarray, "*shape"]:
    """Return the derivative of `squared_under_cauchy`."""
    square = np.minimum(residuals**2, _LARGEST_EXPONENT)
    size = np.sqrt(square)
    return np.where(size < 1e-6, 1.0, size * np.exp(square) / np.sqrt(np.expm1(np.maximum(square, 1e-12))))
