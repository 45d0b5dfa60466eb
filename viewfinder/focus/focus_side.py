"""Which of two answers is right: the focus nearer or farther than a board that shows both the same blur."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

from mrbokeh.optics.lens import Lens
from viewfinder.focus.edge_spread import EdgeBlurs
from viewfinder.focus.focus_from_blur import FocusCandidate, total_cost

# Half the squares by which one answer must fit better, in units of their variance: a likelihood ratio of e^10.
_CLEARLY_BETTER = 10.0
_SAME_PX = 2.0


@dataclass(frozen=True)
class Evidence:
    """now: the blurs of this frame, before: those of earlier ones with this focus, from which the camera may have moved.

    settled_dioptres: the last answer. width_px: of the pictures.
    """

    now: EdgeBlurs
    before: Sequence[EdgeBlurs]
    lens: Lens
    width_px: int
    settled_dioptres: float | None = None


def settled(candidates: Sequence[FocusCandidate], evidence: Evidence) -> FocusCandidate | None:
    """By this frame's depths, else by what earlier frames showed, else by the answer before; None where nothing tells.

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
