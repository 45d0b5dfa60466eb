"""Islands: the pixels of a slice that lie so far apart that their lights do not meet, each spread in a window of its own.

A slice of a slanted or rolling surface is a ring or a few patches in a window that is mostly empty, and spreading costs by the
window. Islands' lights do not overlap, so it makes no difference which of them claims its share of the pupil first.
"""

from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np

from mrbokeh.layering.slice_sorting import Part

_LEAST_CELL_PX = 16
_MOST_CELLS = 64
_PIXELS_PER_SPREAD = 1 << 14
"""What it costs to spread once more, in pixels of a window."""


def islands(parts: Sequence[Part], reach: int, size: tuple[int, int]) -> Iterator[list[Part]]:
    """The parts of a slice whose light travels so far at most, island by island; size: height and width of the frame with its margin."""
    from mrbokeh.layering._slice_islands_numba import islands_of_runs, join_islands, mark_cells, number_islands

    cell_px = max(_LEAST_CELL_PX, 2 * reach, -(-max(size) // _MOST_CELLS))
    cells = np.zeros((-(-size[0] // cell_px), -(-size[1] // cell_px)), np.int32)
    for part in parts:
        mark_cells(cells, cell_px, part.runs, part.pixels.places, size[1])
    boxes = np.tile(np.array([size[0], 0, size[1], 0]), (number_islands(cells), 1))
    own = [islands_of_runs(boxes, cells, cell_px, part.runs, part.pixels.places, size[1]) for part in parts]
    joined = join_islands(boxes, reach, _PIXELS_PER_SPREAD)
    if not joined.any():
        yield list(parts)
        return
    for island in np.unique(joined):
        cut = [replace(part, runs=part.runs[joined[of_runs] == island]) for part, of_runs in zip(parts, own, strict=True)]
        yield [part for part in cut if len(part.runs) > 0]
