"""Semi-global aggregation of label costs along eight directions (Hirschmueller 2008), row by row in NumPy: nothing compiles first."""

import numpy as np
from jaxtyping import Float32

Volume = Float32[np.ndarray, "labels height width"]


def aggregate_costs(costs: Volume, small: float, large: float) -> Volume:
    """Return the sums over eight paths: a step by one label along a path costs `small`, any larger step `large`."""
    total = _swept(np.ascontiguousarray(costs.transpose(0, 2, 1)), (0,), small, large)
    return _swept(costs, (1, 0, -1), small, large, np.ascontiguousarray(total.transpose(0, 2, 1)))


def _swept(costs: Volume, moves: tuple[int, ...], small: float, large: float, total: Volume | None = None) -> Volume:
    """Return `total` with the path costs of both ways along the rows."""
    total = np.zeros_like(costs) if total is None else total
    for way in (slice(None), slice(None, None, -1)):
        _sweep(costs[:, way], moves, small, large, total[:, way])
    return total


def _sweep(costs: Volume, moves: tuple[int, ...], small: float, large: float, total: Volume) -> None:
    """Add the path costs from row to row, for paths that come from as many columns to the left as each of `moves` says."""
    labels, height, width = costs.shape
    # One column and one label more on either side: paths begin at 0 beyond the picture, and there are no labels beyond the last.
    before, path = (np.zeros((len(moves), labels + 2, width + 2), np.float32) for _ in range(2))
    for each in (before, path):
        each[:, [0, -1]] = np.inf
    stepped = np.empty((len(moves), labels, width), np.float32)
    for row in range(height):
        for index, move in enumerate(moves):
            came = before[index, :, 1 - move : 1 - move + width]
            goes = path[index, 1:-1, 1:-1]
            np.minimum(came[:-2], came[2:], out=stepped[index])
            stepped[index] += small
            np.minimum(stepped[index], came[1:-1], out=goes)
        inner = path[:, 1:-1, 1:-1]
        np.minimum(inner, large, out=inner)
        inner += costs[:, row]
        total[:, row] += inner.sum(axis=0)
        inner -= inner.min(axis=1, keepdims=True)
        before, path = path, before
