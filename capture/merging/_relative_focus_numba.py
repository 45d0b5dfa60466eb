"""Sums and searches over the evidence of blur, compiled."""

import numpy as np
from numba import njit

_SPENT = 4.0


@njit(cache=True, fastmath=True)
def _misfit(errors: np.ndarray, gaps: np.ndarray, squares: np.ndarray, wanted: float) -> float:
    """The squared difference at a squared diameter: of pictures that go over linearly between the rungs, which is exact."""
    rung = 0
    last = squares.shape[0] - 2
    while rung < last and squares[rung + 1] < wanted:
        rung += 1
    share = (wanted - squares[rung]) / (squares[rung + 1] - squares[rung])
    share = min(max(share, 0.0), 1.0)
    return max((1.0 - share) * errors[rung] + share * errors[rung + 1] - share * (1.0 - share) * gaps[rung], 0.0)


@njit(cache=True, fastmath=True)
def _lessened(misfit: float) -> float:
    """Cauchy's cost: what fits badly everywhere still tells the better from the worse."""
    return np.log(1.0 + misfit)


@njit(cache=True, fastmath=True)
def _bounded(misfit: float) -> float:
    """Outliers cost no more than _SPENT."""
    return misfit / (1.0 + misfit / _SPENT)


@njit(cache=True)
def sum_curves(
    errors: np.ndarray,
    gaps: np.ndarray,
    squares: np.ndarray,
    weight: np.ndarray,
    nearest: np.ndarray,
    block: np.ndarray,
    base: np.ndarray,
    own_blur: np.ndarray,
    candidates: np.ndarray,
    curves: np.ndarray,
) -> None:
    """Add up, for every pair (slice, bin of cells sharp in a slice) and block of the picture, the misfits at base + candidate.

    errors (cells, slices, rungs; below 0: silent), gaps (cells, rungs - 1), base (cells, slices),
    curves (slices, bins, blocks, candidates).
    """
    cells, slices = errors.shape[:2]
    farthest = np.sqrt(squares[-1])
    for cell in range(cells):
        if weight[cell] <= 0.0:
            continue
        for one in range(slices):
            if errors[cell, one, 0] < 0.0 or base[cell, one] > farthest:
                continue
            row = curves[one, nearest[cell], block[cell]]
            for k in range(candidates.shape[0]):
                diameter = max(base[cell, one] + candidates[k], 0.0)
                wanted = max(diameter * diameter - own_blur[cell], 0.0)
                row[k] += weight[cell] * _lessened(_misfit(errors[cell, one], gaps[cell], squares, wanted))


@njit(cache=True, fastmath=True)
def best_offsets(
    errors: np.ndarray,
    gaps: np.ndarray,
    squares: np.ndarray,
    positions: np.ndarray,
    start: np.ndarray,
    step: np.ndarray,
    own: np.ndarray,
    prior: np.ndarray,
    reach: int,
    offsets: np.ndarray,
    bends: np.ndarray,
) -> None:
    """For every cell the offset (in steps of its own) from `start` that explains all slices best, and how the cost bends there (per px^2).

    own (cells, slices): how much of the all-in-focus picture comes from each slice. prior: what one px^2 of offset costs.
    """
    cells, slices = errors.shape[:2]
    costs = np.empty(2 * reach + 1)
    farthest = np.sqrt(squares[-1])
    for cell in range(cells):
        for k in range(2 * reach + 1):
            away = (k - reach) * step[cell]
            place = start[cell] + away
            own_blur = 0.0
            for one in range(slices):
                own_blur += own[cell, one] * (positions[one] - place) ** 2
            total = prior[cell] * away * away
            for one in range(slices):
                if errors[cell, one, 0] < 0.0 or abs(positions[one] - start[cell]) > farthest:
                    continue
                wanted = max((positions[one] - place) ** 2 - own_blur, 0.0)
                total += _bounded(_misfit(errors[cell, one], gaps[cell], squares, wanted))
            costs[k] = total
        best = 0
        for k in range(1, 2 * reach + 1):
            if costs[k] < costs[best]:
                best = k
        inside = min(max(best, 1), 2 * reach - 1)
        bend = costs[inside - 1] - 2.0 * costs[inside] + costs[inside + 1]
        shift = 0.0
        if bend > 1e-9:
            shift = min(max(0.5 * (costs[inside - 1] - costs[inside + 1]) / bend, -1.0), 1.0)
        offsets[cell] = (inside - reach + shift) * step[cell]
        bends[cell] = max(bend, 0.0) / (step[cell] * step[cell])
