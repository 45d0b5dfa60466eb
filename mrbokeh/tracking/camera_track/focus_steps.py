"""Takes the steps out of focus distances that a camera wrote rounded, without moving any by more than half a step.

A smooth sequence is sought among those that round to what was written: averaging with neighbours on both sides, which knows no lag,
alternates with clipping to half a step (projections onto convex sets, Bregman 1965). The average is a Gaussian and what that takes
away averaged once more ("twicing", Tukey 1977), for a plain one pulls a curve into chords: on rounded sines it left more error than
the rounding. Lens encoders and the tables behind them step neither in metres nor evenly in dioptres, so the step is measured around
each value.
"""

import numpy as np
from jaxtyping import Float64
from scipy.ndimage import gaussian_filter1d

Samples = Float64[np.ndarray, " samples"]

_NEIGHBOURS = 4
_SIGMA_FRAMES = 3.0
_ROUNDS = 60


def quantisation_steps(values: Samples) -> Samples:
    """At each sample the least distance between two of the values that occur around its own; 0 where only one occurs."""
    levels, of_sample = np.unique(values, return_inverse=True)
    if len(levels) == 1:
        return np.zeros_like(values)
    gaps = np.diff(levels)
    steps = [gaps[max(index - _NEIGHBOURS, 0) : index + _NEIGHBOURS].min() for index in range(len(levels))]
    return np.array(steps)[of_sample]


def smoothed_within_steps(values: Samples) -> Samples:
    """Samples within half a step of those given, as smooth as that allows about."""
    reach = 0.5 * quantisation_steps(values)
    low, high = values - reach, values + reach
    smooth = values
    for _ in range(_ROUNDS):
        smooth = np.clip(_averaged(smooth), low, high)
    return smooth


def _averaged(values: Samples) -> Samples:
    """Mirrored through the first and last sample, so that a steady pull stays as it is at its ends."""
    pad = min(len(values) - 1, int(6 * _SIGMA_FRAMES))
    before, after = 2.0 * values[0] - values[pad:0:-1], 2.0 * values[-1] - values[-2 : -pad - 2 : -1]
    longer = np.concatenate([before, values, after])
    once = gaussian_filter1d(longer, _SIGMA_FRAMES, mode="nearest")
    twice = once + gaussian_filter1d(longer - once, _SIGMA_FRAMES, mode="nearest")
    return twice[pad : pad + len(values)]
