"""Checks of single pictures: numbers that are none, alpha outside [0, 1], negative light, and the ledger of light."""

import numpy as np
from jaxtyping import Bool, Float32

from mrbokeh.checks.checked_picture import SHARP, VIRTUAL, CheckedPicture
from mrbokeh.checks.findings import CheckReport, Finding
from mrbokeh.images.color import convert
from mrbokeh.images.exr_io import BT2020_from_rec709
from mrbokeh.images.layer import Layer

Rgb = Float32[np.ndarray, "height width 3"]
Plane = Float32[np.ndarray, "height width"]

ALPHA_SLACK = 1e-3
"""What half floats and sums of weights may be off."""
DARK_SLACK = 1e-4
_BORDER_PX = 2


def check_numbers(report: CheckReport, picture: CheckedPicture, plate_rgb: Rgb | None) -> None:
    """The picture and its layers, which are rendered in Rec.709 and have nothing below 0.

    Strong colours of a camera are negative in Rec.709: in the picture only what is below the plate counts, or, without one, what no
    colour of BT.2020 has. What storing does is allowed; of lossy films nothing can be said.
    """
    light = _in_bt2020(picture.rgb) if plate_rgb is None else picture.rgb - np.minimum(plate_rgb, np.float32(0.0))
    _check(report, picture.name, picture.rgb, picture.alpha, light, DARK_SLACK + picture.storage.dark_step)
    for name, layer in picture.layers.items():
        _check(report, f"{picture.name}, layer {name}", layer.rgb, layer.alpha, layer.rgb, DARK_SLACK)


def _in_bt2020(rgb: Rgb) -> Rgb:
    return np.where(np.isfinite(rgb), convert(np.nan_to_num(rgb, posinf=0.0, neginf=0.0), BT2020_from_rec709), np.float32(np.nan))


def _check(report: CheckReport, where: str, rgb: Rgb, alpha: Plane | None, light: Rgb, slack: float) -> None:
    """light: the picture as far as it must not be negative."""
    lost = ~np.isfinite(rgb).all(axis=2)
    if alpha is not None:
        lost |= ~np.isfinite(alpha)
    _note(report, "nan", where, lost, "NaN or infinity", float(lost.sum()), 0.0)
    dark = np.where(np.isfinite(light), light, np.float32(0.0)).min(axis=2)
    _note(report, "negative", where, dark < -slack, "negative light", float(dark.min()), -slack)
    if alpha is not None:
        known = np.where(np.isfinite(alpha), alpha, np.float32(0.0))
        above, below = known > 1.0 + ALPHA_SLACK, known < -ALPHA_SLACK
        _note(report, "alpha", where, above, "alpha above 1", float(known.max()), 1.0 + ALPHA_SLACK)
        _note(report, "alpha", where, below, "alpha below 0", float(known.min()), -ALPHA_SLACK)


def _note(
    report: CheckReport, check: str, where: str, bad: Bool[np.ndarray, "height width"], what: str, value: float, limit: float
) -> None:
    if bad.any():
        y, x = np.argwhere(bad)[0]
        report.findings.append(Finding(check, where, f"{what} in {int(bad.sum())} px, the first at {x},{y}", value, limit))


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
