"""Checks of single pictures: numbers that are none, alpha outside [0, 1], negative light, and the ledger of light."""

import numpy as np
from jaxtyping import Bool, Float32

from mrbokeh.layer import Layer
from mrbokeh.picture_checks.checked_picture import SHARP, VIRTUAL, CheckedPicture
from mrbokeh.picture_checks.findings import CheckReport, Finding

Rgb = Float32[np.ndarray, "height width 3"]
Plane = Float32[np.ndarray, "height width"]

ALPHA_SLACK = 1e-3
"""What half floats and sums of weights may be off."""
DARK_SLACK = 1e-4
_BORDER_PX = 2


def check_numbers(report: CheckReport, picture: CheckedPicture, plate_rgb: Rgb | None) -> None:
    """The picture and its layers. plate_rgb: a strong colour of a camera may be negative in Rec.709; only what is below it counts."""
    floor = np.float32(0.0) if plate_rgb is None else np.minimum(plate_rgb, 0.0)
    _check(report, picture.name, picture.rgb, picture.alpha, floor)
    for name, layer in picture.layers.items():
        _check(report, f"{picture.name}, layer {name}", layer.rgb, layer.alpha, np.float32(0.0))


def _check(report: CheckReport, where: str, rgb: Rgb, alpha: Plane | None, floor: Rgb | np.float32) -> None:
    lost = ~np.isfinite(rgb).all(axis=2)
    if alpha is not None:
        lost |= ~np.isfinite(alpha)
    _note(report, "nan", where, lost, "pixels are NaN or infinite", float(lost.sum()), 0.0)
    dark = np.where(np.isfinite(rgb), rgb - floor, np.float32(0.0)).min(axis=2)
    _note(report, "negative", where, dark < -DARK_SLACK, "pixels have negative light", float(dark.min()), -DARK_SLACK)
    if alpha is not None:
        known = np.where(np.isfinite(alpha), alpha, np.float32(0.0))
        above, below = known > 1.0 + ALPHA_SLACK, known < -ALPHA_SLACK
        _note(report, "alpha", where, above, "pixels have alpha above 1", float(known.max()), 1.0 + ALPHA_SLACK)
        _note(report, "alpha", where, below, "pixels have alpha below 0", float(known.min()), -ALPHA_SLACK)


def _note(
    report: CheckReport, check: str, where: str, bad: Bool[np.ndarray, "height width"], what: str, value: float, limit: float
) -> None:
    if bad.any():
        y, x = np.argwhere(bad)[0]
        report.findings.append(Finding(check, where, f"{int(bad.sum())} {what}, the first at {x},{y}", value, limit))


def check_energy(report: CheckReport, picture: CheckedPicture, tolerance: float) -> None:
    """Light of the virtual layer before and after the blur. More is a finding; less only where no light can have left the frame.

    The sharp layer is that which was blurred: what the scene hides is gone from it already.
    """
    sharp, blurred = picture.layers.get(SHARP), picture.layers.get(VIRTUAL)
    if sharp is None or blurred is None:
        return
    for what, before, after in (
        ("light", _light(sharp.rgb), _light(blurred.rgb)),
        ("coverage", _light(sharp.alpha), _light(blurred.alpha)),
    ):
        ratio = after / before if before > 0 else (1.0 if after == 0 else float("inf"))
        report.raise_measure(f"largest {what} after over before", ratio)
        report.measures[f"smallest {what} after over before"] = min(ratio, report.measures.get(f"smallest {what} after over before", ratio))
        lost = ratio < 1.0 - tolerance and not _leaves_the_frame(blurred)
        if ratio > 1.0 + tolerance or lost or not np.isfinite(ratio):
            sentence = f"{what} of the virtual layer was {before:.6g} before the blur and is {after:.6g} after it ({ratio - 1:+.2%})"
            report.findings.append(Finding("energy", picture.name, sentence, ratio, 1.0 - tolerance if lost else 1.0 + tolerance))


def _light(values: np.ndarray) -> float:
    return float(np.where(np.isfinite(values), values, 0.0).sum(dtype=np.float64))


def _leaves_the_frame(layer: Layer) -> bool:
    lit = (layer.alpha > 0) | (layer.rgb > 0).any(axis=2)
    inner = lit[_BORDER_PX:-_BORDER_PX, _BORDER_PX:-_BORDER_PX]
    return int(lit.sum()) > int(inner.sum())
