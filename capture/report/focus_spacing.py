"""Whether slices follow one another as they should: in order, none missing, none twice, close enough in dioptres."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool

GAP = 1.6
"""A step larger than this many usual ones means that a slice is missing; a rail or a lens motor steps evenly to a few percent."""
_SAME = 0.2


@dataclass(frozen=True)
class FocusSpacing:
    """focus_dioptres: in the order of the slices. usual_step: in dioptres. largest_step: in steps of its neighbours.

    gaps: indices of the slices after which one or more are missing. out_of_order: slices that go back. doubled: slices at the focus of
    the one before.
    """

    focus_dioptres: tuple[float, ...]
    usual_step: float
    largest_step: float
    gaps: tuple[int, ...]
    out_of_order: tuple[int, ...]
    doubled: tuple[int, ...]

    @property
    def is_even(self) -> bool:
        return not (self.gaps or self.out_of_order or self.doubled)


def focus_spacing(focus_distances_m: Sequence[float], known: Bool[np.ndarray, " slices"] | None = None) -> FocusSpacing:
    """inf is allowed. A stack whose steps grow or shrink steadily is even too: each step is held against its neighbours.

    known: where distances are; steps from and to the others are not judged. None: all of them.
    """
    dioptres = 1.0 / np.asarray(focus_distances_m, np.float64)
    told = np.ones(len(dioptres), bool) if known is None else known
    steps = np.where(told[1:] & told[:-1], np.diff(dioptres), np.nan)
    direction = np.sign(_median(steps)) or 1.0
    sizes = np.abs(steps)
    usual = _median(sizes)
    local = np.array([_around(sizes, i, usual) for i in range(len(sizes))])
    return FocusSpacing(
        tuple(float(each) for each in dioptres),
        usual,
        float(np.nanmax(sizes / np.maximum(local, 1e-12), initial=1.0)),
        tuple(int(i) for i in np.flatnonzero(sizes > GAP * local)),
        tuple(int(i) + 1 for i in np.flatnonzero((steps * direction < 0) & (sizes >= _SAME * local))),
        tuple(int(i) + 1 for i in np.flatnonzero(sizes < _SAME * local)),
    )


def _around(sizes: np.ndarray, index: int, usual: float) -> float:
    """The median step of up to two neighbours on either side, without the step itself."""
    near = [sizes[i] for i in range(max(0, index - 2), min(len(sizes), index + 3)) if i != index]
    return _median(near) if np.isfinite(near).any() else usual


def _median(values: Sequence[float] | np.ndarray) -> float:
    """Return the median of those that are known; 0 where none is."""
    known = np.asarray(values, np.float64)[np.isfinite(values)]
    return float(np.median(known)) if len(known) else 0.0
