"""Plain twins of the compiled loops of spreadlets, slow and obvious."""

import numpy as np
from jaxtyping import Bool, Float, Float32, Float64

from mrbokeh.renderers.kernels.laplacian_tables import AROUND_PX, OUTSHINES, Points
from mrbokeh.renderers.spreadlets.laplacian_spreadlets import EVERY, OUTSHINES_MEAN, Codes, Highlights
from mrbokeh.renderers.spreadlets.sums import Cells, Sums, Values


def integrate_reference(source: Float[np.ndarray, "height width channels"]) -> Float64[np.ndarray, "height width channels"]:
    """Integrate by a sparse linear solver: the slow and obvious twin of `integrate`."""
    from scipy.sparse import diags, eye, kron
    from scipy.sparse.linalg import spsolve

    height, width, channels = source.shape
    ends = np.zeros(width)
    ends[[0, -1]] += 1.0  # antisymmetric about the border: the neighbour beyond is minus the pixel itself
    row = diags([np.ones(width - 1), -ends, np.ones(width - 1)], [-1, 0, 1])
    column = diags([np.ones(height - 1), np.ones(height - 1)], [-1, 1], shape=(height, height))
    matrix = kron(eye(height), 4.0 * row - 20.0 * eye(width)) + kron(column, row + 4.0 * eye(width))
    solved = [spsolve((matrix / 6.0).tocsc(), source[..., c].ravel().astype(np.float64)) for c in range(channels)]
    return np.stack([each.reshape(height, width) for each in solved], axis=2)


def stands_out_reference(values: Float32[np.ndarray, "height width channels"]) -> Bool[np.ndarray, "height width"]:
    """Return what `stands_out` returns, by a box filter of OpenCV."""
    import cv2

    window = (2 * AROUND_PX + 1, 2 * AROUND_PX + 1)
    around = cv2.boxFilter(np.abs(values, dtype=np.float64), cv2.CV_64F, window, borderType=cv2.BORDER_REFLECT_101)
    return np.any(np.abs(values) > OUTSHINES * around.reshape(values.shape), axis=2)


def splat_reference(sums: Sums, values: Values, cells: Cells, points: Points, origin: tuple[int, int]) -> None:
    """Add every pixel's points to sums one by one, as `splat` does."""
    for y, x in np.argwhere(cells >= 0):
        part = slice(points.starts[cells[y, x]], points.starts[cells[y, x] + 1])
        for (right, down), weight in zip(points.xy[part], points.weights[part], strict=True):
            sums[y + down - origin[0], x + right - origin[1]] += weight * values[y, x]


def highlights_among_reference(values: Values, codes: Codes, sparse: Bool[np.ndarray, " kinds"]) -> Highlights:
    """Return what `highlights_among` returns, without compiled loops."""
    mine, light = (codes >= 0) & sparse[codes], np.abs(values)
    some = light[::EVERY][mine[::EVERY]]
    limits = OUTSHINES_MEAN * (some if some.size else light[mine]).mean(axis=0, dtype=np.float64)
    found = mine & (light > limits.astype(np.float32)).any(axis=2)
    return Highlights(found, light[mine & ~found].max(axis=0, initial=0.0))
