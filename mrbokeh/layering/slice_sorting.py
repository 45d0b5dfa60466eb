"""Which pixels of which sheets make up a slice, and which part of the frame they reach."""

from collections.abc import Sequence
from concurrent.futures import Executor
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float32, Int32

from mrbokeh.layering.sheets import Pixels
from mrbokeh.layering.spreading import Frame
from mrbokeh.system.resources import bands

_BAND_PIXELS = 1 << 14

Window = tuple[slice, slice]
Shares = Float32[np.ndarray, " _"]


@dataclass(frozen=True)
class Part:
    """Some pixels of a sheet and how much of every pixel of the sheet is meant.

    runs: first number and end of pixels that lie side by side, row by row.
    """

    pixels: Pixels
    shares: Shares
    runs: Int32[np.ndarray, "runs 2"]


def sorted_slices(
    sheets: Sequence[Pixels], shares: Sequence[Shares], step_px: float, width: int, pool: Executor
) -> list[tuple[int, list[Part]]]:
    """Numbers and parts of the slices that are not empty, front first; circles of confusion nearest to that multiple of the step.

    width: of the frame that places are counted in.
    """
    used = [(sheet, share) for sheet, share in zip(sheets, shares, strict=True) if share.any()]
    runs = [_runs(*each, np.float32(step_px), width, pool) for each in used]
    slices = np.unique(np.concatenate([np.empty(0, np.int32), *(of_runs for of_runs, _ in runs)]))
    cuts = [np.split(of_sheet, np.searchsorted(of_runs, slices[1:])) for of_runs, of_sheet in runs]
    parts = [[Part(*each, cut) for each, cut in zip(used, cut_of, strict=True) if len(cut) > 0] for cut_of in zip(*cuts, strict=True)]
    return list(zip(slices.tolist(), parts, strict=True))


def _runs(
    sheet: Pixels, shares: Shares, step_px: np.float32, width: int, pool: Executor
) -> tuple[Int32[np.ndarray, " runs"], Int32[np.ndarray, "runs 2"]]:
    """The slices of a sheet's runs, ascending, and the runs, in order within each slice."""
    from mrbokeh.layering._slices_numba import runs_of_slices

    pixels = sheet.places, sheet.coc_px, shares, width, step_px
    found = list(pool.map(lambda band: runs_of_slices(*pixels, *band), bands(len(shares), _BAND_PIXELS)))
    runs = np.concatenate([np.empty((0, 3), np.int32), *found])
    runs = runs[np.argsort(runs[:, 0], kind="stable")]
    return runs[:, 0].copy(), runs[:, 1:].copy()


def window_of(parts: Sequence[Part], reach: int, frame: Frame) -> Window | None:
    """The smallest window that holds what is seen of these pixels and the pixels that it comes from; None if nothing is seen.

    reach: how many pixels their light travels at most. Rows and columns are those of an array that lies as the frame says.
    """
    from mrbokeh.layering._slices_numba import extent

    width = frame.width_px - 2 * frame.left_px
    tops, bottoms, lefts, rights = zip(*(extent(part.runs, part.pixels.places, width) for part in parts), strict=True)
    rows = _span(min(tops), max(bottoms), reach, -frame.top_px, frame.height_px)
    columns = _span(min(lefts), max(rights), reach, -frame.left_px, frame.width_px)
    return None if rows is None or columns is None else (rows, columns)


def _span(first: int, end: int, reach: int, inside: int, length: int) -> slice | None:
    """Of pixels first to end those that reach the inside, together with what of it they reach."""
    first, end = max(first, inside - reach), min(end, inside + length + reach)
    return slice(min(first, max(first - reach, inside)), max(end, min(end + reach, inside + length))) if first < end else None
