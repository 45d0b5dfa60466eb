"""Two passes whose width changes from pixel to pixel, and a mask where that fails: McGraw's own way with a blur that varies.

The second pass knows the pixels that the first one reached, not where their light came from: it filters by the diameter
found there. Where the diameter changes slowly that is nearly the right one; near an edge of depth it is not. As in the
paper, edges are found by finite differences, grown by the blur and left to full 2D filtering.
"""

from collections.abc import Callable, Iterable

import numpy as np
from jaxtyping import Bool, Float32, Float64, Int

from mrbokeh.renderers.kernels.low_rank_kernel import LowRankKernel

EDGE_PX = 1.0
"""Where neighbouring pixels differ by more than this in signed diameter, there is an edge."""
_STEP_PX = 0.5
_PIECE_PX = 64


def depth_edge_mask(
    coc_px: Float32[np.ndarray, "height width"], lit: Bool[np.ndarray, "height width"], unit_radius: float
) -> Bool[np.ndarray, "height width"]:
    """Return a mask of the pixels within whose reach there is an edge: an abrupt change of the (signed) diameter, or a pixel without light.

    The reach of a pixel is the square around it that its kernel takes, rounded up to a power of two.
    """
    import cv2

    edges = ~lit
    signed_px = np.where(lit, coc_px, np.float32(0.0))
    for axis in (0, 1):
        steep = np.abs(np.diff(signed_px, axis=axis)) > EDGE_PX
        pad = [(0, 1) if axis == each else (0, 0) for each in (0, 1)]
        edges |= np.pad(steep, pad) | np.pad(steep, [each[::-1] for each in pad])
    radii_px = 0.5 * unit_radius * np.abs(signed_px) + 0.5
    mask = edges.copy()
    radius_px = 1
    while radius_px < 2.0 * radii_px.max():
        window = np.ones((2 * radius_px + 1, 2 * radius_px + 1), np.uint8)
        near = cv2.dilate(edges.astype(np.uint8), window, borderType=cv2.BORDER_CONSTANT, borderValue=0) > 0
        mask |= near & (radii_px > radius_px / 2) & (radii_px <= radius_px)
        radius_px *= 2
    return mask & lit


def scatter_per_pixel(
    out: Float32[np.ndarray, "height width channels"],
    values: Float32[np.ndarray, "height width channels"],
    shares: Float32[np.ndarray, "height width"],
    diameters_px: Float32[np.ndarray, "height width"],
    kernel_at: Callable[[float], LowRankKernel],
    mirrored: bool,
    each: Callable[[Callable, Iterable], Iterable] = map,
) -> None:
    """Add share * value of every pixel to out, term by term, across and then down; diameters_px unsigned."""
    from mrbokeh.renderers.low_rank._filter_numba import across, down

    columns, rows, radii_px = _tables(float(diameters_px.max()), kernel_at, mirrored)
    positions = diameters_px / np.float32(_STEP_PX)
    middle = np.empty_like(values)
    height, width = diameters_px.shape
    for term in range(columns.shape[0]):

        def run_across(top: int, table: np.ndarray = rows[term]) -> None:
            part = slice(top, top + _PIECE_PX)
            across(middle[part], values[part], shares[part], positions[part], table, radii_px)

        def run_down(left: int, table: np.ndarray = columns[term]) -> None:
            part = np.s_[:, left : left + _PIECE_PX]
            down(out[part], middle[part], positions[part], table, radii_px)

        list(each(run_across, range(0, height, _PIECE_PX)))
        list(each(run_down, range(0, width, _PIECE_PX)))


def _tables(
    largest_px: float, kernel_at: Callable[[float], LowRankKernel], mirrored: bool
) -> tuple[Float32[np.ndarray, "terms levels size"], Float32[np.ndarray, "terms levels size"], Int[np.ndarray, " levels"]]:
    """Return scaled columns and rows of the kernels at all steps up to the largest diameter, term by term in step with one another."""
    kernels = [kernel_at(_STEP_PX * i) for i in range(int(np.ceil(largest_px / _STEP_PX)) + 2)]
    terms, size = max(kernel.rank for kernel in kernels), 2 * max(kernel.radius_px for kernel in kernels) + 1
    columns, rows = np.zeros((len(kernels), terms, size)), np.zeros((len(kernels), terms, size))
    for i in reversed(range(len(kernels))):
        kernel = kernels[i]
        inset = size // 2 - kernel.radius_px
        part = np.s_[i, : kernel.rank, inset : size - inset]
        columns[part], rows[part] = kernel.scaled_columns, kernel.scaled_rows
        if i + 1 < len(kernels):
            _put_in_step(columns[i], rows[i], columns[i + 1], rows[i + 1])
    order = slice(None, None, -1) if mirrored else slice(None)
    by_term = [np.ascontiguousarray(each.transpose(1, 0, 2)[..., order], np.float32) for each in (columns, rows)]
    return by_term[0], by_term[1], np.array([kernel.radius_px for kernel in kernels])


def _put_in_step(
    columns: Float64[np.ndarray, "terms size"],
    rows: Float64[np.ndarray, "terms size"],
    next_columns: Float64[np.ndarray, "terms size"],
    next_rows: Float64[np.ndarray, "terms size"],
) -> None:
    """Reorder terms and flip signs so that every term is most like the same term of the next larger kernel; in place.

    Singular vectors come in any order of nearly equal weights and with any sign, which would make a blend of two meaningless.
    """
    likeness = (next_columns @ columns.T) * (next_rows @ rows.T)
    free = list(range(len(columns)))
    order = np.zeros(len(columns), int)
    for term in range(len(columns)):
        order[term] = free.pop(int(np.argmax(likeness[term, free])))
    columns[:], rows[:] = columns[order], rows[order]
    signs = np.where(np.sum(columns * next_columns, axis=1) < 0, -1.0, 1.0)[:, None]
    columns *= signs
    rows *= signs
