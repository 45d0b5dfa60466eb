"""The gates of one stack; stack_rules says what they ask and why."""

from collections.abc import Callable

import numpy as np

from capture.report.findings import SliceFindings, StackFindings
from capture.report.gates import Gate, Rule
from capture.report.picture_gates import picture_gates
from capture.report.slice_fit import Change
from capture.report.stack_rules import (
    BLUR,
    DEPTH,
    EXPOSURE,
    FOCUS,
    LARGEST_BEYOND,
    LARGEST_BLUR_GAIN,
    LARGEST_DEPTH_SHARE,
    LARGEST_EXPOSURE,
    LARGEST_FOCUS_PX,
    LARGEST_GAIN_DRIFT,
    LARGEST_JUMP,
    LARGEST_MOVING,
    LARGEST_SATURATED,
    LARGEST_SHIFT_PX,
    LEAST_CORRELATION,
    LEAST_DB,
    LEAST_TRUSTED,
    MOTION,
    NO_PREDICTION,
    PLACE,
    RANGE,
    REGISTRATION,
    RESIDUAL,
    SATURATION,
    SOLVED_BLUR,
    SOLVED_FOCUS,
    SPACING,
    TEXTURE,
)
from mrbokeh.stacks.guessed_metres import metres_facts


def stack_gates(findings: StackFindings) -> list[Gate]:
    """Judge a stack; its gates come in the order in which to read them."""
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


def _spacing(findings: StackFindings) -> Gate:
    spacing = findings.spacing
    if spacing is None:
        return SPACING.absent(findings.name, "focus distances are unknown: add focus_distances_m to lens.toml and ingest again")
    troubles = [f"gap after slice {i}" for i in spacing.gaps] + [f"slice {i} goes back" for i in spacing.out_of_order]
    troubles += [f"slice {i} is where the one before is" for i in spacing.doubled]
    measured = (
        "; ".join(troubles)
        or f"usual step {spacing.usual_step:.3f} dioptres, the largest {spacing.largest_step:.2f} times that of its neighbours"
    )
    return SPACING.judge(findings.name, spacing.largest_step, measured, spacing.is_even)


def _range(findings: StackFindings) -> Gate:
    curve = findings.curve
    if curve.trusted == 0.0:
        return RANGE.absent(findings.name, "no focus can be trusted anywhere")
    beyond = max(curve.beyond_near, curve.beyond_far)
    measured = f"{curve.beyond_near:.0%} at the first slice, {curve.beyond_far:.0%} at the last"
    return RANGE.judge(findings.name, beyond, measured, beyond <= LARGEST_BEYOND)


def _texture(findings: StackFindings) -> Gate:
    trusted = findings.curve.trusted
    return TEXTURE.judge(findings.name, trusted, f"{trusted:.0%} of the picture", trusted >= LEAST_TRUSTED)


def _registration(findings: StackFindings) -> Gate:
    if findings.drift is None:
        return REGISTRATION.absent(findings.name, "the stack does not say how it was registered: run `mrbokeh capture merge`")
    drift, least = findings.drift, findings.drift.least_correlation
    jump = drift.largest_jump_px / drift.width_px
    matched = "correlations are not known"
    if least is not None:
        pair = drift.correlations.index(least)
        matched = f"correlation {least:.3f} between slices {pair} and {pair + 1}"
    passed = jump <= LARGEST_JUMP and (least is None or least >= LEAST_CORRELATION)
    return REGISTRATION.judge(findings.name, jump, f"{matched}; largest jump {drift.largest_jump_px:.1f} px", passed)


def _saturation(findings: StackFindings) -> Gate:
    worst = max(findings.slices, key=lambda each: each.saturated)
    measured = f"{worst.saturated:.2%} of slice {worst.index}"
    return SATURATION.judge(findings.name, worst.saturated, measured, worst.saturated <= LARGEST_SATURATED)


def _exposure(findings: StackFindings) -> Gate:
    if all(each.fit is not None for each in findings.slices):
        return _worst(EXPOSURE, findings, lambda fit: fit.exposure, LARGEST_EXPOSURE, lambda value: f"{value:+.2%}")
    gains = np.array([each.gain for each in findings.slices])
    if not np.isfinite(gains).any():
        return EXPOSURE.absent(findings.name, "no part of the picture is valid and unsaturated in the slices")
    drifts = gains / np.nanmedian(gains) - 1.0
    worst = int(np.nanargmax(np.abs(drifts)))
    drift = float(drifts[worst])
    measured = f"{drift:+.1%} in slice {worst} (low frequencies)"
    return EXPOSURE.judge(findings.name, abs(drift), measured, abs(drift) <= LARGEST_GAIN_DRIFT)


def _residual(findings: StackFindings) -> Gate:
    known = [each for each in findings.slices if each.psnr_db is not None]
    if not known:
        return RESIDUAL.absent(findings.name, NO_PREDICTION)
    worst = min(known, key=lambda each: each.psnr_db or 0.0)
    decibel, unblurred = worst.psnr_db or 0.0, worst.unblurred_db or 0.0
    measured = f"{decibel:.1f} dB in slice {worst.index} ({unblurred:.1f} dB without blur)"
    return RESIDUAL.judge(findings.name, decibel, measured, decibel >= LEAST_DB)


def _focus(findings: StackFindings) -> Gate:
    rule = _solved_or_stated(findings, SOLVED_FOCUS, FOCUS)
    return _worst(rule, findings, lambda fit: fit.focus_px, LARGEST_FOCUS_PX, lambda value: f"{value:+.2f} px")


def _blur(findings: StackFindings) -> Gate:
    rule, gains = _solved_or_stated(findings, SOLVED_BLUR, BLUR), _known(findings, lambda fit: fit.blur_gain)
    if not gains:
        return rule.absent(findings.name, NO_PREDICTION)
    gain = mean_change([change for _, change in gains])
    measured = f"{gain.value:+.1%} (standard error {gain.error:.1%})"
    return rule.judge(findings.name, gain.value, measured, not gain.exceeds(LARGEST_BLUR_GAIN))


def mean_change(changes: list[Change], floor: float = 0.02) -> Change:
    """Weighted by certainty; floor: what a slice is off by itself, so that a very sure one does not decide alone."""
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
        return PLACE.absent(findings.name, NO_PREDICTION)
    worst, change = max(known, key=lambda pair: (pair[1].exceeds(LARGEST_SHIFT_PX), pair[1].value))
    measured = f"{change.value:.2f} px in slice {worst.index}"
    return PLACE.judge(findings.name, change.value, measured, not change.exceeds(LARGEST_SHIFT_PX))


def _depth(findings: StackFindings) -> Gate:
    share = findings.depth_off_share
    if share is None:
        return DEPTH.absent(findings.name, NO_PREDICTION)
    return DEPTH.judge(findings.name, share, f"{share:.1%} of the picture", share <= LARGEST_DEPTH_SHARE)


def _motion(findings: StackFindings) -> Gate:
    share = findings.moving_share
    if share is None:
        clipped = "clipped highlights light nearly all of the picture: photograph with less exposure"
        return MOTION.absent(findings.name, NO_PREDICTION if findings.depth_off_share is None else clipped)
    return MOTION.judge(findings.name, share, f"{share:.2%} of the picture", share <= LARGEST_MOVING)


def _worst(rule: Rule, findings: StackFindings, change_of: Callable[..., Change], limit: float, text: Callable[[float], str]) -> Gate:
    """The slice that exceeds a limit farthest; else the one with the largest number that is known."""
    known = _known(findings, change_of)
    if not known:
        return rule.absent(findings.name, NO_PREDICTION)
    index, change = max(known, key=lambda pair: (pair[1].exceeds(limit), abs(pair[1].value)))
    return rule.judge(findings.name, change.value, f"{text(change.value)} in slice {index}", not change.exceeds(limit))


def _solved_or_stated(findings: StackFindings, solved: Rule, stated: Rule) -> Rule:
    """The rule for what merging solved from the slices, or for what files state."""
    return solved if metres_facts(findings.stack) else stated


def _known(findings: StackFindings, change_of: Callable[..., Change]) -> list[tuple[int, Change]]:
    """Changes that the slices tell, each with the number of its slice."""
    changes = [(each.index, change_of(each.fit)) for each in findings.slices if each.fit is not None]
    return [pair for pair in changes if np.isfinite(pair[1].error)]
