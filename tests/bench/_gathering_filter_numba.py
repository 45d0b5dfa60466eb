"""The loop of tests.bench.blur_methods.gathered, compiled."""

import numpy as np

from mrbokeh.system.kernels import njit


@njit(cache=True, nogil=True, fastmath={"contract"})
def _add(out: np.ndarray, weight: float, light: np.ndarray) -> None:
    for i in range(out.shape[0]):
        out[i] += weight * light[i]


@njit(cache=True, nogil=True)
def gather_rows(
    out: np.ndarray,
    values: np.ndarray,
    cells: np.ndarray,
    taps: np.ndarray,
    weights: np.ndarray,
    starts: np.ndarray,
    margin_px: int,
    channels: int,
    first: int,
    end: int,
) -> None:
    """Fill rows first:end of out (H, W * C): each pixel takes values at itself less every tap of its cell.

    values (H + 2 margin, (W + 2 margin) * C); cells (H, W); taps (N, 2) x, y of cell i at starts[i]:starts[i + 1], none farther than
    the margin. Neighbours of one cell go together, so that a tap is one run of multiplications.
    """
    width = cells.shape[1]
    for y in range(first, end):
        begin = 0
        while begin < width:
            cell, stop = cells[y, begin], begin + 1
            while stop < width and cells[y, stop] == cell:
                stop += 1
            run, length = out[y, begin * channels : stop * channels], (stop - begin) * channels
            for n in range(starts[cell], starts[cell + 1]):
                row, at = y + margin_px - taps[n, 1], (begin + margin_px - taps[n, 0]) * channels
                _add(run, weights[n], values[row, at : at + length])
            begin = stop
