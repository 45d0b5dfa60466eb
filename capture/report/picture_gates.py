"""Gates that need neither lens nor focus distances: the all-in-focus picture beside its slices, and the slices beside one another."""

from collections.abc import Sequence

from capture.merging.merge import HIGHLIGHTS
from capture.report.findings import StackFindings
from capture.report.gates import Gate
from capture.report.neighbour_places import NeighbourPlace
from capture.report.stack_rules import (
    LARGEST_APART,
    LARGEST_APART_PX,
    LARGEST_FLAT,
    LARGEST_LOST,
    LARGEST_PAIR_RESIDUAL,
    LARGEST_TOP,
    LIGHT,
    NO_BLOCKS,
    PLACES,
    SEAMS,
    SHARP,
)


def picture_gates(findings: StackFindings) -> list[Gate]:
    return [_sharp(findings), _seams(findings), _light(findings), _places(findings)]


def _sharp(findings: StackFindings) -> Gate:
    lost = findings.picture.lost
    if lost is None:
        return SHARP.absent(findings.name, NO_BLOCKS)
    return SHARP.judge(findings.name, lost, f"{lost:.2%} of the textured blocks are lost", lost <= LARGEST_LOST)


def _seams(findings: StackFindings) -> Gate:
    flat = findings.picture.flat
    if flat is None:
        return SEAMS.absent(findings.name, NO_BLOCKS)
    return SEAMS.judge(findings.name, flat, f"{flat:.3f} times the detail of the sharpest slice in flat zones", flat <= LARGEST_FLAT)


def _light(findings: StackFindings) -> Gate:
    picture, supported = findings.picture, largest_supported(findings)
    measured = f"largest value {picture.top:.3g}, {picture.top_ratio:.2f} times that of the slices"
    if supported > 0.0:
        measured += f"; measured flux supports {supported:.3g}"
    allowed = max(LARGEST_TOP * picture.slices_top, supported)
    return LIGHT.judge(findings.name, picture.top_ratio, measured, picture.top <= allowed)


def largest_supported(findings: StackFindings) -> float:
    """The largest value that the flux of discs in the slices speaks for, as merging left it in the metadata; 0 where it left none."""
    drawn = findings.stack.metadata.get(HIGHLIGHTS)
    value = drawn.get("largest_supported") if isinstance(drawn, dict) else None
    return float(value) if isinstance(value, int | float) else 0.0


def _places(findings: StackFindings) -> Gate:
    """Pairs of neighbours as they lie, else as the registration left them; those that nobody measured are named."""
    if not findings.pairs:
        return PLACES.absent(findings.name, "there are no neighbouring slices to compare: photograph more than one")
    width_px = findings.full_size_px[0]
    limit_px = max(LARGEST_APART_PX, LARGEST_APART * width_px)
    # A pair that may lie too far apart, and may as well not, was not measured.
    measured = [each for each in findings.pairs if each.off_px is not None and (each.off_px <= limit_px or each.exceeds(limit_px))]
    residuals = _pair_residuals_px(findings, measured)
    worst_residual = max(residuals.items(), key=lambda pair: pair[1], default=None)
    parts = []
    if measured:
        worst = max(measured, key=lambda each: (each.exceeds(limit_px), each.rank()))
        parts.append(f"slices {worst.first} and {worst.first + 1} lie {worst.off_px:.2f} px apart (standard error {worst.error_px:.2f})")
    if worst_residual is not None:
        first, residual_px = worst_residual
        parts.append(f"pairs of the registration disagree by {residual_px:.1f} px at slices {first} and {first + 1}")
    unknown = [str(each.first) for each in findings.pairs if each not in measured and each.first not in residuals]
    if unknown:
        parts.append(
            f"slices {', '.join(unknown)} cannot be placed surely, as little is sharp in two, and no pair of the registration held"
        )
    if not measured and worst_residual is None:
        return PLACES.absent(findings.name, f"{'; '.join(parts)}: use smaller focus steps")
    wrong = any(each.exceeds(limit_px) for each in measured)
    disagree = worst_residual is not None and worst_residual[1] > LARGEST_PAIR_RESIDUAL * width_px
    value = max([each.off_px or 0.0 for each in measured] + list(residuals.values()))
    return PLACES.judge(findings.name, value, "; ".join(parts), not (wrong or disagree))


def _pair_residuals_px(findings: StackFindings, measured: Sequence[NeighbourPlace]) -> dict[int, float]:
    """Return, by the first slice of each pair that was not measured, the smaller residual, for a pair that is wrong raises both."""
    residuals = () if findings.drift is None else findings.drift.residuals_px
    if len(residuals) != len(findings.slices):
        return {}
    known: dict[int, float] = {}
    for each in findings.pairs:
        both = [residuals[index] for index in (each.first, each.first + 1)]
        if each not in measured and None not in both:
            known[each.first] = min(float(value or 0.0) for value in both)
    return known
