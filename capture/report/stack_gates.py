"""Gates of one stack and of a whole scene; `capture.report.gates` says what those of a stack ask and why.

A scene's ask that viewpoints are placed, points consistent, and that two scales agree.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from capture.merging.merge import HIGHLIGHTS, ghosts_text
from capture.merging.retouch import retouches_text
from capture.poses.sparse_model import POSES_NAME, SCALE_NAME, SparseModel, read_sparse_model
from capture.report import gates as rules
from capture.report.exclusion import FEWEST_SLICES
from capture.report.findings import SliceFindings, StackFindings
from capture.report.gates import Gate, Rule
from capture.report.registration_check import NeighbourDisplacement
from capture.report.slice_fit import Change
from mrbokeh.stacks.focal_stack import FocalStack
from mrbokeh.stacks.guessed_metres import SLICE_POSITION, metres_facts
from mrbokeh.system.atomic_files import read_json

FOLDER = "reconstruction"
LARGEST_REPROJECTION_PX = 1.0
LARGEST_DISAGREEMENT = 0.01
WHERE = "scene"

MERGED = Rule(
    "all stacks merged",
    "all-in-focus picture and depth of every stack",
    "Nothing else can be judged before.",
    "Run `mrbokeh capture merge` on the scene.",
)
PLACED = Rule(
    "all viewpoints placed",
    "none left out",
    "A viewpoint without a pose has no depth but that from focus.",
    "Photograph viewpoints that overlap more; see poses.json for the names.",
)
REPROJECTION = Rule(
    "points lie where they are seen",
    f"median below {LARGEST_REPROJECTION_PX:g} px",
    "Poses that do not fit the pictures give depth that does not fit them.",
    "Check that all stacks have one lens and reference focus; run `mrbokeh capture poses --overwrite`.",
)
SCALES = Rule(
    "scales agree",
    f"within {LARGEST_DISAGREEMENT:.0%}",
    "Metres from a board or a known distance, and metres from the focus distances, are two answers to one question. Re-blurring cannot see "
    "an error of all focus distances by one dioptre offset; this can.",
    "If they disagree, trust the board and calibrate the lens against it (`mrbokeh capture scale`, then `depth`).",
)
SCENE_RULES = (MERGED, PLACED, REPROJECTION, SCALES)


def stack_gates(findings: StackFindings) -> list[Gate]:
    """Judge a stack; its gates come in the order in which to read them, those that need neither lens nor focus distances first."""
    return [
        *picture_gates(findings),
        _spacing(findings),
        _range(findings),
        _texture(findings),
        _registration(findings),
        _saturation(findings),
        _exposure(findings),
        _residual(findings),
        _focus(findings),
        _blur(findings),
        _place(findings),
        _depth(findings),
        _motion(findings),
    ]


def picture_gates(findings: StackFindings) -> list[Gate]:
    return [_sharp(findings), _seams(findings), _ghosts(findings), _light(findings), _places(findings)]


def _sharp(findings: StackFindings) -> Gate:
    lost = findings.picture.lost
    if lost is None:
        return rules.SHARP.absent(findings.name, rules.NO_BLOCKS)
    measured = f"{lost:.2%} of the textured blocks are lost{_moved(findings)}"
    return rules.SHARP.judge(findings.name, lost, measured, lost <= rules.LARGEST_LOST)


def _seams(findings: StackFindings) -> Gate:
    flat = findings.picture.flat
    if flat is None:
        return rules.SEAMS.absent(findings.name, rules.NO_BLOCKS)
    return rules.SEAMS.judge(
        findings.name, flat, f"{flat:.3f} times the detail of the sharpest slice in flat zones", flat <= rules.LARGEST_FLAT
    )


def _ghosts(findings: StackFindings) -> Gate:
    unlike = findings.picture.unlike
    measured = f"{unlike:.2%} of the picture is unlike every slice{_moved(findings)}"
    return rules.GHOSTS.judge(findings.name, unlike, measured, unlike <= rules.LARGEST_UNLIKE)


def _moved(findings: StackFindings) -> str:
    """Say what was taken from slices on purpose, by merging or by hand."""
    retouched = retouches_text(findings.stack)
    return "".join(f"; {told}" for told in (ghosts_text(findings.stack), f"retouched: {retouched}" if retouched else "") if told)


def _light(findings: StackFindings) -> Gate:
    picture, supported = findings.picture, largest_supported(findings)
    measured = f"largest value {picture.top:.3g}, {picture.top_ratio:.2f} times that of the slices"
    if supported > 0.0:
        measured += f"; measured flux supports {supported:.3g}"
    allowed = max(rules.LARGEST_TOP * picture.slices_top, supported)
    return rules.LIGHT.judge(findings.name, picture.top_ratio, measured, picture.top <= allowed)


def largest_supported(findings: StackFindings) -> float:
    """Return the largest value that the flux of discs in the slices supports, as merging left it in the metadata; 0 where it left none."""
    drawn = findings.stack.metadata.get(HIGHLIGHTS)
    value = drawn.get("largest_supported") if isinstance(drawn, dict) else None
    return float(value) if isinstance(value, int | float) else 0.0


def _places(findings: StackFindings) -> Gate:
    """Judge pairs of neighbours as they lie, else as the registration left them; those that nobody measured are named."""
    if not findings.pairs:
        return rules.PLACES.absent(findings.name, "there are no neighbouring slices to compare: photograph more than one")
    width_px = findings.full_size_px[0]
    limit_px = max(rules.LARGEST_APART_PX, rules.LARGEST_APART * width_px)
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
    shifted = max(findings.pairs, key=lambda each: each.parallax_px)
    is_shifted = shifted.parallax_px > rules.LARGEST_PARALLAX * width_px
    if is_shifted:
        names = f"slices {shifted.first} and {shifted.first + 1}"
        parts.append(f"things at other depths lie up to {shifted.parallax_px:.0f} px apart in {names}")
    unknown = [str(each.first) for each in findings.pairs if each not in measured and each.first not in residuals]
    if unknown:
        parts.append(
            f"slices {', '.join(unknown)} cannot be placed surely, as little is sharp in two, and no pair of the registration held"
        )
    if not measured and worst_residual is None and not is_shifted:
        return rules.PLACES.absent(findings.name, f"{'; '.join(parts)}: use smaller focus steps")
    wrong = any(each.exceeds(limit_px) for each in measured)
    disagree = worst_residual is not None and worst_residual[1] > rules.LARGEST_PAIR_RESIDUAL * width_px
    value = max([each.off_px or 0.0 for each in measured] + list(residuals.values()) + [shifted.parallax_px] * is_shifted)
    return rules.PLACES.judge(findings.name, value, "; ".join(parts), not (wrong or disagree or is_shifted))


def _pair_residuals_px(findings: StackFindings, measured: Sequence[NeighbourDisplacement]) -> dict[int, float]:
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


def _spacing(findings: StackFindings) -> Gate:
    positions_px = [each.metadata.get(SLICE_POSITION) for each in findings.stack.slices]
    if len(positions_px) > 1 and None not in positions_px:
        midway = 0.5 * np.abs(np.diff(np.array(positions_px, np.float64))) / findings.full_size_px[0]
        first = int(midway.argmax())
        largest = float(midway[first])
        blur_px = largest * findings.full_size_px[0]
        measured = f"what lies midway between slices {first} and {first + 1} is blurred by {blur_px:.1f} px"
        return rules.SOLVED_SPACING.judge(findings.name, largest, f"{measured} ({largest:.2%})", largest <= rules.LARGEST_MIDWAY)
    spacing = findings.spacing
    if spacing is None:
        return rules.SPACING.absent(findings.name, "focus distances are unknown: add focus_distances_m to lens.toml and ingest again")
    troubles = [f"gap after slice {i}" for i in spacing.gaps] + [f"slice {i} goes back" for i in spacing.out_of_order]
    troubles += [f"slice {i} is where the one before is" for i in spacing.doubled]
    measured = (
        "; ".join(troubles)
        or f"usual step {spacing.usual_step:.3f} dioptres, the largest {spacing.largest_step:.2f} times that of its neighbours"
    )
    return rules.SPACING.judge(findings.name, spacing.largest_step, measured, spacing.is_even)


def _range(findings: StackFindings) -> Gate:
    curve = findings.curve
    if curve.trusted == 0.0:
        return rules.RANGE.absent(findings.name, "no focus can be trusted anywhere")
    beyond = max(curve.beyond_near, curve.beyond_far)
    measured = f"{curve.beyond_near:.0%} at the first slice, {curve.beyond_far:.0%} at the last"
    return rules.RANGE.judge(findings.name, beyond, measured, beyond <= rules.LARGEST_BEYOND)


def _texture(findings: StackFindings) -> Gate:
    trusted = findings.curve.trusted
    return rules.TEXTURE.judge(findings.name, trusted, f"{trusted:.0%} of the picture", trusted >= rules.LEAST_TRUSTED)


def _registration(findings: StackFindings) -> Gate:
    if findings.drift is None:
        return rules.REGISTRATION.absent(findings.name, "the stack does not say how it was registered: run `mrbokeh capture merge`")
    drift, least = findings.drift, findings.drift.least_correlation
    jump = drift.largest_jump_px / drift.width_px
    matched = "correlations are not known"
    if least is not None:
        pair = drift.correlations.index(least)
        matched = f"correlation {least:.3f} between slices {pair} and {pair + 1}"
    passed = jump <= rules.LARGEST_JUMP and (least is None or least >= rules.LEAST_CORRELATION)
    return rules.REGISTRATION.judge(findings.name, jump, f"{matched}; largest jump {drift.largest_jump_px:.1f} px", passed)


def _saturation(findings: StackFindings) -> Gate:
    worst = max(findings.slices, key=lambda each: each.saturated)
    measured = f"{worst.saturated:.2%} of slice {worst.index}"
    return rules.SATURATION.judge(findings.name, worst.saturated, measured, worst.saturated <= rules.LARGEST_SATURATED)


def _exposure(findings: StackFindings) -> Gate:
    if all(each.fit is not None for each in findings.slices):
        return _worst(rules.EXPOSURE, findings, lambda fit: fit.exposure, rules.LARGEST_EXPOSURE, lambda value: f"{value:+.2%}")
    gains = np.array([each.gain for each in findings.slices])
    if not np.isfinite(gains).any():
        return rules.EXPOSURE.absent(findings.name, "no part of the picture is valid and unsaturated in the slices")
    drifts = gains / np.nanmedian(gains) - 1.0
    worst = int(np.nanargmax(np.abs(drifts)))
    drift = float(drifts[worst])
    measured = f"{drift:+.1%} in slice {worst} (low frequencies)"
    return rules.EXPOSURE.judge(findings.name, abs(drift), measured, abs(drift) <= rules.LARGEST_GAIN_DRIFT)


def _residual(findings: StackFindings) -> Gate:
    known = [each for each in findings.slices if each.psnr_db is not None]
    if not known:
        return rules.RESIDUAL.absent(findings.name, rules.NO_PREDICTION)
    worst = min(known, key=lambda each: each.psnr_db or 0.0)
    decibel, unblurred = worst.psnr_db or 0.0, worst.unblurred_db or 0.0
    measured = f"{decibel:.1f} dB in slice {worst.index} ({unblurred:.1f} dB without blur)"
    return rules.RESIDUAL.judge(findings.name, decibel, measured, decibel >= rules.LEAST_DB)


def _focus(findings: StackFindings) -> Gate:
    rule = _solved_or_stated(findings, rules.SOLVED_FOCUS, rules.FOCUS)
    return _worst(rule, findings, lambda fit: fit.focus_px, rules.LARGEST_FOCUS_PX, lambda value: f"{value:+.2f} px")


def _blur(findings: StackFindings) -> Gate:
    rule, gains = _solved_or_stated(findings, rules.SOLVED_BLUR, rules.BLUR), _known(findings, lambda fit: fit.blur_gain)
    if not gains:
        return rule.absent(findings.name, rules.NO_PREDICTION)
    gain = mean_change([change for _, change in gains])
    measured = f"{gain.value:+.1%} (standard error {gain.error:.1%})"
    return rule.judge(findings.name, gain.value, measured, not gain.exceeds(rules.LARGEST_BLUR_GAIN))


def mean_change(changes: list[Change], floor: float = 0.02) -> Change:
    """Average changes by certainty. floor: what a slice is off by itself, so that a very sure one does not decide alone."""
    weights = np.array([1.0 / (each.error**2 + floor**2) for each in changes])
    values = np.array([each.value for each in changes])
    return Change(float((weights * values).sum() / weights.sum()), float(weights.sum() ** -0.5))


def _place(findings: StackFindings) -> Gate:
    half_diagonal_px = 0.5 * float(np.hypot(*findings.size_px))

    def farthest_px(each: SliceFindings) -> Change:
        fit = each.fit
        assert fit is not None
        shift = float(np.hypot(fit.shift_x_px.value, fit.shift_y_px.value)) + abs(fit.magnification.value) * half_diagonal_px
        error = float(np.hypot(fit.shift_x_px.error, fit.shift_y_px.error)) + fit.magnification.error * half_diagonal_px
        return Change(shift, error)

    known = [(each, farthest_px(each)) for each in findings.slices if each.fit is not None]
    if not known:
        return rules.PLACE.absent(findings.name, rules.NO_PREDICTION)
    worst, change = max(known, key=lambda pair: (pair[1].exceeds(rules.LARGEST_SHIFT_PX), pair[1].value))
    measured = f"{change.value:.2f} px in slice {worst.index}"
    return rules.PLACE.judge(findings.name, change.value, measured, not change.exceeds(rules.LARGEST_SHIFT_PX))


def _depth(findings: StackFindings) -> Gate:
    share = findings.depth_off_share
    if share is None:
        return rules.DEPTH.absent(findings.name, rules.NO_PREDICTION)
    return rules.DEPTH.judge(findings.name, share, f"{share:.1%} of the picture", share <= rules.LARGEST_DEPTH_SHARE)


def _motion(findings: StackFindings) -> Gate:
    share = findings.moving_share
    if share is None:
        return rules.MOTION.absent(findings.name, _why_movement_is_unknown(findings))
    return rules.MOTION.judge(findings.name, share, f"{share:.2%} of the picture", share <= rules.LARGEST_MOVING)


def _why_movement_is_unknown(findings: StackFindings) -> str:
    if findings.depth_off_share is None:
        return rules.NO_PREDICTION
    if len(findings.slices) < FEWEST_SLICES:
        return f"movement shows from {FEWEST_SLICES} slices on, and here are {len(findings.slices)}: look at the picture yourself"
    return "clipped highlights light nearly all of the picture: photograph with less exposure"


def _worst(rule: Rule, findings: StackFindings, change_of: Callable[..., Change], limit: float, text: Callable[[float], str]) -> Gate:
    """Judge the slice that exceeds a limit farthest; else the one with the largest number that is known."""
    known = _known(findings, change_of)
    if not known:
        return rule.absent(findings.name, rules.NO_PREDICTION)
    index, change = max(known, key=lambda pair: (pair[1].exceeds(limit), abs(pair[1].value)))
    return rule.judge(findings.name, change.value, f"{text(change.value)} in slice {index}", not change.exceeds(limit))


def _solved_or_stated(findings: StackFindings, solved: Rule, stated: Rule) -> Rule:
    """Return the rule for what merging solved from the slices, or for what files state."""
    return solved if metres_facts(findings.stack) else stated


def _known(findings: StackFindings, change_of: Callable[..., Change]) -> list[tuple[int, Change]]:
    """Return changes that the slices tell, each with the number of its slice."""
    changes = [(each.index, change_of(each.fit)) for each in findings.slices if each.fit is not None]
    return [pair for pair in changes if np.isfinite(pair[1].error)]


@dataclass(frozen=True)
class Reconstruction:
    """Camera poses of a scene; model and scales are None where they are not there. scales: metres per unit by method."""

    model: SparseModel | None
    scales: dict[str, float] | None

    @property
    def disagreement(self) -> float | None:
        """Return the largest ratio of two scales, minus 1; None where there are not two."""
        if self.scales is None or len(self.scales) < 2:
            return None
        return max(self.scales.values()) / min(self.scales.values()) - 1.0


def read_reconstruction(scene: Path) -> Reconstruction:
    folder = scene / FOLDER
    model = read_sparse_model(folder) if (folder / POSES_NAME).is_file() else None
    path = folder / SCALE_NAME
    return Reconstruction(model, scales_in(read_json(path, "the metric scale")) if path.is_file() else None)


def scales_in(document: dict[str, Any]) -> dict[str, float]:
    """Return every method's answer, or the one that is used."""
    answers = document.get("answers", [])
    entries = answers.values() if isinstance(answers, dict) else answers
    found = {str(each["method"]): float(each["metres_per_unit"]) for each in entries if isinstance(each, dict)}
    return found or {str(document.get("method", "used")): float(document["metres_per_unit"])}


def merged_gate(stacks: Sequence[FocalStack]) -> Gate:
    waiting = [stack.folder.name for stack in stacks if not stack.merged]
    named = f" (waiting: {', '.join(waiting)})" if waiting else ""
    return MERGED.judge(WHERE, float(len(waiting)), f"{len(stacks) - len(waiting)} of {len(stacks)}{named}", not waiting)


def scene_gates(reconstruction: Reconstruction) -> list[Gate]:
    model = reconstruction.model
    if model is None:
        no_poses = "no reconstruction: run `mrbokeh capture poses` (needs two viewpoints or more)"
        return [PLACED.absent(WHERE, no_poses), REPROJECTION.absent(WHERE, no_poses), SCALES.absent(WHERE, no_poses)]
    out, total = len(model.left_out), len(model.left_out) + len(model.views)
    left_out = f" (left out: {', '.join(model.left_out)})" if out else ""
    placed = PLACED.judge(WHERE, float(out), f"{total - out} of {total}{left_out}", out == 0)
    return [placed, _reprojection(model), _scales(reconstruction)]


def _reprojection(model: SparseModel) -> Gate:
    if not len(model.errors_px):
        return REPROJECTION.absent(WHERE, "the reconstruction has no points")
    median_px = float(np.median(model.errors_px))
    return REPROJECTION.judge(WHERE, median_px, f"{median_px:.2f} px over {len(model.points)} points", median_px < LARGEST_REPROJECTION_PX)


def _scales(reconstruction: Reconstruction) -> Gate:
    disagreement = reconstruction.disagreement
    if disagreement is None:
        known = "none" if not reconstruction.scales else f"only {', '.join(reconstruction.scales)}"
        return SCALES.absent(WHERE, f"two scales are needed, there is {known}: `mrbokeh capture scale` with a board or a distance")
    listed = ", ".join(f"{method} {metres:.6g} m per unit" for method, metres in (reconstruction.scales or {}).items())
    measured = f"{disagreement:.2%} apart ({listed})"
    return SCALES.judge(WHERE, disagreement, measured, disagreement <= LARGEST_DISAGREEMENT)
