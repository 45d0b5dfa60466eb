"""Focus of a lens from how blurred things of known depth are: c = k |1/d_f - 1/z| (Lens.coc_px) fitted over many edges.

One depth leaves two answers, one nearer and one farther than it. Edges at several depths tell them apart: towards the focus
plane the blur shrinks. How surely is the difference of what the two leave unexplained; `settled` chooses.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float64
from scipy.optimize import minimize_scalar

from mrbokeh.optics.lens import MM_PER_M, Lens
from viewfinder.focus.edge_blur import EdgeBlurs

FEWEST_EDGES = 8

_STEP_PX = 0.2
_CLOSEST_FOCAL_LENGTHS = 4.0
_MOST_STEPS = 4000
_CAUCHY = 2.385
_APART_PX = 0.5


@dataclass(frozen=True)
class FocusCandidate:
    """Focus that explains the blurs.

    cost: half the squares that are left, robust and in units of their variance. sigma_dioptres: standard deviation.
    """

    dioptres: float
    cost: float
    sigma_dioptres: float

    @property
    def focus_distance_m(self) -> float:
        return 1.0 / self.dioptres if self.dioptres > 0.0 else float("inf")


def focus_candidates(blurs: EdgeBlurs, lens: Lens, width_px: int) -> tuple[FocusCandidate, ...]:
    """Return the best answer, then the best one on the other side of the board, where there is one; none with too few edges.

    lens: its focus distance is not looked at. width_px: of the picture in which the blurs were measured.
    """
    if len(blurs) < FEWEST_EDGES:
        return ()
    steps = _dioptres(lens, width_px)
    costs = np.array([blur_cost(blurs, lens, width_px, each) for each in steps])
    low = np.flatnonzero((np.r_[np.inf, costs[:-1]] >= costs) & (costs < np.r_[costs[1:], np.inf]))
    found = sorted((_refined(blurs, lens, width_px, steps, int(index)) for index in low), key=lambda each: each.cost)
    if not found:
        return ()
    best, middle = found[0], float(np.median(1.0 / blurs.depth_m))
    apart = _APART_PX / lens.coc_px_per_dioptre(width_px)
    others = [
        each
        for each in found[1:]
        if (each.dioptres - middle) * (best.dioptres - middle) <= 0 and abs(each.dioptres - best.dioptres) > apart
    ]
    return best, *others[:1]


def blur_cost(blurs: EdgeBlurs, lens: Lens, width_px: int, dioptres: float) -> float:
    """Cauchy's loss (95 % efficient for normal errors, Holland and Welsch 1977) of what a focus leaves unexplained."""
    return float(_losses(blurs, lens, width_px, dioptres).sum())


def total_cost(history: Sequence[EdgeBlurs], lens: Lens, width_px: int, dioptres: float) -> float:
    return sum(blur_cost(blurs, lens, width_px, dioptres) for blurs in history)


def _losses(blurs: EdgeBlurs, lens: Lens, width_px: int, dioptres: float) -> Float64[np.ndarray, " edges"]:
    focused = lens.focused_at(1.0 / dioptres if dioptres > 0.0 else np.inf)
    off = (np.abs(focused.coc_px(blurs.depth_m, width_px)) - blurs.diameter_px) / blurs.sigma_px
    return 0.5 * _CAUCHY**2 * np.log1p((off / _CAUCHY) ** 2)


def _dioptres(lens: Lens, width_px: int) -> Float64[np.ndarray, " steps"]:
    """Return steps from infinity to four focal lengths, finely enough for a fifth of a pixel."""
    nearest = MM_PER_M / (_CLOSEST_FOCAL_LENGTHS * lens.focal_length_mm)
    per_dioptre = lens.focused_at(np.inf).coc_px_per_dioptre(width_px)
    return np.linspace(0.0, nearest, int(np.clip(nearest * per_dioptre / _STEP_PX, 50, _MOST_STEPS)))


def _refined(blurs: EdgeBlurs, lens: Lens, width_px: int, steps: Float64[np.ndarray, " steps"], index: int) -> FocusCandidate:
    between = (steps[max(index - 1, 0)], steps[min(index + 1, len(steps) - 1)])
    found = minimize_scalar(lambda each: blur_cost(blurs, lens, width_px, float(each)), bounds=between, method="bounded")
    dioptres, cost = float(found.x), float(found.fun)
    # The error of one edge is sigma / k; of all together, where they err on their own.
    per_dioptre = lens.focused_at(1.0 / dioptres if dioptres > 0 else np.inf).coc_px_per_dioptre(width_px)
    spread = max(1.0, 2.0 * cost / len(blurs)) ** 0.5
    return FocusCandidate(dioptres, cost, spread / (per_dioptre * float(np.sqrt(np.sum(blurs.sigma_px**-2.0)))))


# Half the squares by which one answer must fit better, in units of their variance: a likelihood ratio of e^10.
_CLEARLY_BETTER = 10.0
_SAME_PX = 2.0


@dataclass(frozen=True)
class FocusEvidence:
    """Blurs by which two answers are told apart.

    now: the blurs of this frame, before: those of earlier ones with this focus, from which the camera may have moved.

    settled_dioptres: the last answer. width_px: of the pictures.
    """

    now: EdgeBlurs
    before: Sequence[EdgeBlurs]
    lens: Lens
    width_px: int
    settled_dioptres: float | None = None


def settled(candidates: Sequence[FocusCandidate], evidence: FocusEvidence) -> FocusCandidate | None:
    """Choose by this frame's depths, else by earlier frames, else by the answer before; None if nothing tells.

    Two answers within a pixel of the board's own depth need not be told apart: their middle is as good.
    """
    if len(candidates) < 2:
        return candidates[0] if candidates else None
    best, other = candidates
    lens, width_px = evidence.lens, evidence.width_px
    if abs(best.dioptres - other.dioptres) * lens.coc_px_per_dioptre(width_px) < _SAME_PX:
        apart = abs(best.dioptres - other.dioptres)
        return replace(best, dioptres=(best.dioptres + other.dioptres) / 2.0, sigma_dioptres=best.sigma_dioptres + apart / 2.0)
    # Where the model itself fits badly, differences count for less.
    needed = _CLEARLY_BETTER * max(1.0, 2.0 * best.cost / len(evidence.now))
    if other.cost - best.cost > needed:
        return best
    lead = sum(
        sign * total_cost([evidence.now, *evidence.before], lens, width_px, each.dioptres) for sign, each in ((1, other), (-1, best))
    )
    if abs(lead) > needed:
        return best if lead > 0 else other
    before = evidence.settled_dioptres
    return None if before is None else min(candidates, key=lambda each: abs(each.dioptres - before))
