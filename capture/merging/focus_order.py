"""The order of slices along their focus, from the pictures alone, for stacks that come in any order.

Fine detail of a place grows up to the slice in which it is sharp and falls after it. So no slice has less of it than two slices on either
side of it both have; what is amiss there, summed over all places and triples, is what an order costs, however uneven its steps are. Which
end is near it does not tell. An order that is as good as the best one, within what noise and chance do, is kept: names of files are
usually right.
"""

from collections.abc import Callable, Sequence

import cv2
import numpy as np
from jaxtyping import Float, Float32

Rgb = Float32[np.ndarray, "height width 3"]
Maps = Float32[np.ndarray, "scales rows columns"]
Violations = Float[np.ndarray, "slices slices slices"]

_WORKING_PX = 640.0
_SCALES_PX = (0.8, 2.0)
_CELL_PX = 12
_KEPT = 0.05
"""The given order stays unless another is better by this share of what slices in no order cost."""
_CLEAR = 0.2
"""An order that costs more than this share is no clear one."""
_NOISE_PERCENTILE = 5.0
_MOST_CELLS = 3000
_MOST_STARTS = 8


def focus_order(read_rgb: Callable[[int], Rgb], count: int) -> tuple[int, ...]:
    """Return slices 0 to count - 1 in the order of their focus, each read once; as given where that is as good as any.

    Of the two directions it takes the one that goes more along the given order.
    """
    given = tuple(range(count))
    if count < 3:
        return given
    violations = violations_of([detail_map(read_rgb(index)) for index in range(count)])
    best = best_order(violations)
    gain = gain_of(violations, given, best)
    if gain < _KEPT or cost_of(violations, best) > _CLEAR * violations.sum() / 6.0:
        return given
    return tuple(best if _rises(best) else best[::-1])


def gain_of(violations: Violations, given: Sequence[int], best: Sequence[int]) -> float:
    """Return by how much the best order is better, as a share of what slices in no order would cost."""
    at_random = float(violations.sum()) / 6.0
    return (cost_of(violations, given) - cost_of(violations, best)) / max(at_random, 1e-12)


def _rises(order: Sequence[int]) -> bool:
    """Whether it goes more along the given order than against it."""
    return float(np.corrcoef(np.arange(len(order)), order)[0, 1]) >= 0.0


def detail_map(rgb: Rgb) -> Maps:
    """Energy of fine detail on a coarse grid, at a few scales, of the square root of light, where photons are evenly noisy."""
    shrink = max(1.0, max(rgb.shape[:2]) / _WORKING_PX)
    size = (round(rgb.shape[1] / shrink), round(rgb.shape[0] / shrink))
    grey = cv2.transform(cv2.resize(rgb, size, interpolation=cv2.INTER_AREA), np.full((1, 3), 1.0 / 3.0, np.float32))
    encoded = np.sqrt(np.maximum(grey, 0.0))
    grid = (max(2, size[0] // _CELL_PX), max(2, size[1] // _CELL_PX))
    maps, finer = [], encoded
    for sigma_px in _SCALES_PX:
        coarser = cv2.GaussianBlur(encoded, (0, 0), sigma_px)
        energy = cv2.resize((finer - coarser) ** 2, grid, interpolation=cv2.INTER_AREA)
        maps.append(cv2.GaussianBlur(energy, (0, 0), 1.0))
        finer = coarser
    return np.stack(maps)


def violations_of(maps: Sequence[Maps]) -> Violations:
    """How far slice b has less detail than both a and c have, summed over cells: what speaks against b between a and c, [a, b, c]."""
    energies = np.stack(maps)
    floor = np.percentile(energies.min(axis=0), _NOISE_PERCENTILE, axis=(1, 2))[None, :, None, None] + 1e-9
    logs = np.log(energies + np.float32(2.0) * floor).astype(np.float32)
    weight = (np.sqrt(energies.max(axis=0)) * np.ptp(logs, axis=0)).ravel()
    cells = np.argsort(weight)[-_MOST_CELLS:]
    logs, weight = logs.reshape(len(maps), -1)[:, cells], weight[cells] / max(float(weight[cells].sum()), 1e-12)
    found = np.zeros((len(maps),) * 3)
    for a in range(len(maps)):
        for c in range(a):
            found[a, :, c] = found[c, :, a] = np.maximum(np.minimum(logs[a], logs[c]) - logs, 0.0) @ weight
    return found


def cost_of(violations: Violations, order: Sequence[int]) -> float:
    """Return what an order costs, summed over all slices that lie between two others."""
    index = np.array(order, int)
    ordered = violations[np.ix_(index, index, index)]
    return float(sum(ordered[:b, b, b + 1 :].sum() for b in range(1, len(order) - 1)))


def best_order(violations: Violations) -> list[int]:
    """Slices put in one after the other where they cost least, then each taken out and put in again, until nothing gets better."""
    count = len(violations)
    found: list[tuple[float, list[int]]] = []
    for start in range(0, count, -(-count // _MOST_STARTS)):
        order: list[int] = []
        for each in [*range(start, count), *range(start)]:
            order = _inserted(violations, order, each)
        cost = cost_of(violations, order)
        while True:
            for moved in range(count):
                order = _inserted(violations, [each for each in order if each != moved], moved)
            better = cost_of(violations, order)
            if not better < cost - 1e-12:
                break
            cost = better
        found.append((cost, order))
    return min(found)[1]


def _inserted(violations: Violations, order: list[int], new: int) -> list[int]:
    """The order with one more slice where it costs least."""
    count = len(order)
    index = np.array(order, int)
    outer = np.triu(violations[:, new][np.ix_(index, index)], 1)
    # Slices b between the new one before them and c behind, and between a and the new one behind.
    behind = np.triu(violations[new][np.ix_(index, index)], 1)
    before = np.triu(violations[..., new][np.ix_(index, index)], 1)
    costs = [outer[:at, at:].sum() + behind[at:, at:].sum() + before[:at, :at].sum() for at in range(count + 1)]
    at = int(np.argmin(costs))
    return [*order[:at], new, *order[at:]]
