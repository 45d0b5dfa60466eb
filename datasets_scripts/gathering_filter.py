"""FILTER, the competitor of Leimkuehler et al. 2018, Section 7: every pixel gathers light with its own PSF instead of giving it away.

Where all pixels share one PSF it is the same as splatting. Where they do not, a pixel in focus takes no light from a blurred
neighbour, and a blurred one takes it from what is sharp: the defect of all methods that filter pictures.
"""

from concurrent.futures import ThreadPoolExecutor

import numpy as np
from jaxtyping import Float, Float32, Int32

from mrbokeh.renderers.kernels.laplacian_tables import Points
from mrbokeh.system.errors import InputError
from mrbokeh.system.resources import cores

_STRIP_ROWS = 16


def gathered(
    values: Float32[np.ndarray, "rows columns channels"],
    cells: Int32[np.ndarray, "height width"],
    taps: Points,
    margin_px: int,
    threads: int = 0,
) -> Float32[np.ndarray, "height width channels"]:
    """At every pixel x the sum over the taps p of its kernel of weight(p) times values(x - p).

    values: with a margin all around, at least as wide as the taps reach. cells: which of the kernels a pixel takes, from 0.
    """
    from datasets_scripts._gathering_filter_numba import gather_rows

    height, width = cells.shape
    channels = values.shape[2]
    if taps.reach_px > margin_px or values.shape[:2] != (height + 2 * margin_px, width + 2 * margin_px):
        raise InputError(
            f"kernels that reach {taps.reach_px} px need light with such a margin around the {width}x{height} px to be filled, "
            f"but it came with {values.shape[1]}x{values.shape[0]} px and a margin of {margin_px} px: continue it"
        )
    out = np.zeros((height, width * channels), np.float32)
    flat = np.ascontiguousarray(values).reshape(len(values), -1)
    weights = taps.weights.astype(np.float32)

    def run(first: int) -> None:
        end = min(first + _STRIP_ROWS, height)
        gather_rows(out, flat, cells, taps.xy, weights, taps.starts, margin_px, channels, first, end)

    with ThreadPoolExecutor(threads or cores()) as pool:
        list(pool.map(run, range(0, height, _STRIP_ROWS)))
    return out.reshape(height, width, channels)


def gathered_plainly(
    values: Float32[np.ndarray, "rows columns channels"], cells: Int32[np.ndarray, "height width"], taps: Points, margin_px: int
) -> Float[np.ndarray, "height width channels"]:
    """The slow and obvious twin of `gathered`, in double precision."""
    out = np.zeros((*cells.shape, values.shape[2]))
    for y, x in np.ndindex(*cells.shape):
        part = slice(taps.starts[cells[y, x]], taps.starts[cells[y, x] + 1])
        for (right, down), weight in zip(taps.xy[part], taps.weights[part], strict=True):
            out[y, x] += weight * values[y + margin_px - down, x + margin_px - right]
    return out
