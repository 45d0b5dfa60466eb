"""Checks of pictures and films, and their findings: NaN, alpha, negative light, energy, leaks and flicker.

Leaks are pixels of the photograph that were changed although no virtual light reaches them. Flicker is how much a film changes from frame
to frame where its plate stands still, beyond what the plate does itself.
"""

from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float32, Int32

from mrbokeh.checks.checked_picture import SHADOW, SHARP, VIRTUAL, CheckedPicture
from mrbokeh.images.color import convert
from mrbokeh.images.exr_io import ACESCG_from_rec709, BT2020_from_rec709
from mrbokeh.images.layer import Layer
from mrbokeh.images.picture_codec import write_stored
from mrbokeh.optics.lens import Lens

FORMAT = "mrbokeh-picture-check"
VERSION = 1


@dataclass(frozen=True)
class Finding:
    """Finding of one check.

    check: its name (nan, alpha, negative, energy, leak, flicker, pop, frozen, missing, damaged, size). where: a picture or its frame.
    value: what was measured; limit: what is allowed, in the same unit.
    """

    check: str
    where: str
    text: str
    value: float
    limit: float


@dataclass
class CheckReport:
    """Findings and measures of all checks.

    measures: numbers by name. skipped: checks that could not be made, with what they would need.
    """

    pictures: int = 0
    findings: list[Finding] = field(default_factory=list)
    measures: dict[str, float] = field(default_factory=dict)
    skipped: dict[str, str] = field(default_factory=dict)

    @property
    def is_clean(self) -> bool:
        return not self.findings

    def raise_measure(self, name: str, value: float) -> None:
        """Keep the largest value of all pictures."""
        self.measures[name] = max(self.measures.get(name, float("-inf")), float(value))

    def to_json(self) -> dict[str, Any]:
        return {
            "format": FORMAT,
            "version": VERSION,
            "clean": self.is_clean,
            "pictures": self.pictures,
            "findings": [{name: _json_value(value) for name, value in vars(each).items()} for each in self.findings],
            "measures": {name: _json_value(value) for name, value in self.measures.items()},
            "skipped": self.skipped,
        }


def _json_value(value: Any) -> Any:
    """Return infinity and NaN, which JSON lacks, as words."""
    return str(value) if isinstance(value, float) and not abs(value) < float("inf") else value


Rgb = Float32[np.ndarray, "height width 3"]
Plane = Float32[np.ndarray, "height width"]

ALPHA_SLACK = 1e-3
"""Error allowed for half floats and sums of weights."""
DARK_SLACK = 1e-4
_BORDER_PX = 2
_SAME_DEPTH = 1e-3


def check_numbers(report: CheckReport, picture: CheckedPicture, plate_rgb: Rgb | None) -> None:
    """Check the picture and its layers for NaN, alpha outside [0, 1] and negative light.

    Strong colours of a camera are negative in Rec.709: in the picture only what is below the plate counts or, without one, what no colour
    of BT.2020 has. In layers, and in files of other primaries, colours that only ACEScg has are none of ours. What storing explains is
    allowed; lossy films cannot be judged.
    """
    light = _in(BT2020_from_rec709, picture.rgb) if plate_rgb is None else picture.rgb - np.minimum(plate_rgb, np.float32(0.0))
    darkest = _least(light, picture.rgb) if picture.storage.mixes else light.min(axis=2)
    _check(report, picture.name, picture.rgb, picture.alpha, darkest, DARK_SLACK + picture.storage.dark_step(picture.rgb))
    for name, layer in picture.layers.items():
        slack = np.full_like(layer.alpha, DARK_SLACK) + (picture.storage.dark_step(layer.rgb) if picture.storage.is_linear else 0.0)
        _check(report, f"{picture.name}, layer {name}", layer.rgb, layer.alpha, _least(layer.rgb, layer.rgb), slack)


def _least(light: Rgb, rgb: Rgb) -> Plane:
    """Return the least channel of the light, or that of the colour in ACEScg where that is more."""
    return np.maximum(light.min(axis=2), _in(ACESCG_from_rec709, rgb).min(axis=2))


def _in(other_from_rec709: np.ndarray, rgb: Rgb) -> Rgb:
    return np.where(np.isfinite(rgb), convert(np.nan_to_num(rgb, posinf=0.0, neginf=0.0), other_from_rec709), np.float32(np.nan))


def _check(report: CheckReport, where: str, rgb: Rgb, alpha: Plane | None, darkest: Plane, slack: Plane) -> None:
    """Check one picture or layer. darkest: the least of its channels, which must not be negative by more than the slack."""
    lost = ~np.isfinite(rgb).all(axis=2)
    if alpha is not None:
        lost |= ~np.isfinite(alpha)
    _note(report, "nan", where, lost, "NaN or infinity", float(lost.sum()), 0.0)
    dark = np.where(np.isfinite(darkest), darkest, np.float32(0.0))
    worst = np.unravel_index(np.argmin(dark + slack), dark.shape)
    _note(report, "negative", where, dark < -slack, "negative light", float(dark[worst]), -float(slack[worst]))
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
        report.findings.append(
            Finding(check=check, where=where, text=f"{what} in {int(bad.sum())} px, the first at {x},{y}", value=value, limit=limit)
        )


def check_energy(report: CheckReport, picture: CheckedPicture, tolerance: float) -> None:
    """Compare the light of the virtual layer before and after the blur.

    More is a finding; less only if no light can have left the frame, and nothing of the layer is hidden, as the picture's depth tells.
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
        lost = ratio < 1.0 - tolerance and not _leaves_the_frame(blurred) and not _is_hidden(sharp, picture.depth_m)
        if ratio > 1.0 + tolerance or lost or not np.isfinite(ratio):
            sentence = f"{what} of the virtual layer was {before:.6g} before the blur and is {after:.6g} after it ({ratio - 1:+.2%})"
            report.findings.append(
                Finding(check="energy", where=picture.name, text=sentence, value=ratio, limit=1.0 - tolerance if lost else 1.0 + tolerance)
            )


def _light(values: np.ndarray) -> float:
    return float(np.where(np.isfinite(values), values, 0.0).sum(dtype=np.float64))


def _leaves_the_frame(layer: Layer) -> bool:
    lit = (layer.alpha > 0) | (layer.rgb > 0).any(axis=2)
    inner = lit[_BORDER_PX:-_BORDER_PX, _BORDER_PX:-_BORDER_PX]
    return int(lit.sum()) > int(inner.sum())


def _is_hidden(sharp: Layer, depth_m: Plane | None) -> bool:
    drawn = (sharp.alpha > 0) & np.isfinite(sharp.depth_m)
    return depth_m is not None and bool((depth_m[drawn] < sharp.depth_m[drawn] * np.float32(1.0 - _SAME_DEPTH)).any())


Mask = Bool[np.ndarray, "height width"]

_RADII = 12
_SPARE_PX = 1.5


def reach(picture: CheckedPicture, lens: Lens | None) -> Mask | None:
    """Return (H, W) where virtual light may arrive or take the photograph's away; None if that is unknown.

    From the blurred layers where the picture has them, else from the sharp layer and the circle of confusion of its lens.
    """
    blurred = [picture.layers[name] for name in (VIRTUAL, SHADOW) if name in picture.layers]
    if blurred:
        return np.logical_or.reduce([(each.alpha != 0) | (each.rgb != 0).any(axis=2) for each in blurred])
    sharp = picture.layers.get(SHARP)
    return None if sharp is None or lens is None else reach_of_sharp(sharp, lens)


def reach_of_sharp(layer: Layer, lens: Lens) -> Mask:
    """Grow every lit pixel by the radius of its circle of confusion, in a few steps of radius that err on the large side."""
    import cv2

    lit = (layer.alpha > 0) | (layer.rgb != 0).any(axis=2)
    radius_px = np.where(lit, np.abs(lens.coc_px(layer.depth_m, layer.width_px)) / 2.0 + _SPARE_PX, 0.0)
    reached = lit.copy()
    steps = np.unique(np.quantile(radius_px[lit], np.linspace(0, 1, _RADII + 1)[1:])) if lit.any() else np.empty(0)
    nearer = -1.0
    for step in steps:
        members = lit & (radius_px > nearer) & (radius_px <= step)
        nearer = step
        if members.any():
            reached |= cv2.distanceTransform((~members).astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_PRECISE) <= step
    return reached


@dataclass
class LeakMap:
    """Count of how often each pixel was changed out of reach, over all pictures."""

    storage_step: float | None = None
    counts: Int32[np.ndarray, "height width"] | None = field(default=None)

    def add(self, report: CheckReport, picture: CheckedPicture, plate_rgb: Float32[np.ndarray, "height width 3"], reached: Mask) -> None:
        storage = picture.storage if self.storage_step is None else replace(picture.storage, step=self.storage_step)
        leaked = storage.changed(picture.rgb, plate_rgb) & ~reached
        self.counts = leaked.astype(np.int32) if self.counts is None else self.counts + leaked
        share = float(leaked.mean())
        report.raise_measure("largest share of pixels that leaked", share)
        if leaked.any():
            y, x = np.argwhere(leaked)[0]
            text = f"{int(leaked.sum())} pixels outside the reach of virtual light were changed, the first at {x},{y}"
            report.findings.append(Finding(check="leak", where=picture.name, text=text, value=share, limit=0.0))

    def write(self, path: Path) -> bool:
        """Write a PNG with the leaked pixels in white, darker if in few pictures only. Returns False if there are none."""
        if self.counts is None or not self.counts.any():
            return False
        shade = np.where(self.counts > 0, np.maximum(64, 255 * self.counts // self.counts.max()), 0).astype(np.uint8)
        write_stored(path, shade)
        return True


_NOISE_SIGMAS = 5.0
_LEAST_STATIC = 2e-3
_POP_FACTOR = 6.0
_NEIGHBOURS = 4
_LEAST_FRAMES = 6


def static_pixels(plate_rgb: Rgb, previous_rgb: Rgb) -> Bool[np.ndarray, "height width"]:
    """Return (H, W) where the plate changes by no more than its own noise, which is measured as the median change."""
    change = np.abs(np.clip(plate_rgb, 0, 1) - np.clip(previous_rgb, 0, 1)).max(axis=2)
    return change <= max(_LEAST_STATIC, _NOISE_SIGMAS * float(np.median(change)) / 0.6745)


def mean_change(rgb: Rgb, previous_rgb: Rgb, where: Bool[np.ndarray, "height width"]) -> float:
    """Return the mean absolute difference of linear light clipped to [0, 1]; 0 if the mask is empty."""
    if not where.any():
        return 0.0
    return float(np.abs(np.clip(rgb[where], 0, 1) - np.clip(previous_rgb[where], 0, 1)).mean(dtype=np.float64))


@dataclass
class FlickerScore:
    """Flicker of a film whose frames go in one by one; two are held."""

    changes: list[float] = field(default_factory=list)
    own_changes: list[float] = field(default_factory=list)
    names: list[str] = field(default_factory=list)
    _previous: tuple[Rgb, Rgb] | None = None

    def add(self, report: CheckReport, name: str, rgb: Rgb, plate_rgb: Rgb) -> None:
        """Add a frame. plate_rgb: the same frame of the plate."""
        rgb = np.nan_to_num(rgb, posinf=1.0, neginf=0.0)
        if self._previous is not None:
            before, plate_before = self._previous
            static = static_pixels(plate_rgb, plate_before)
            self.changes.append(mean_change(rgb, before, static))
            self.own_changes.append(mean_change(plate_rgb, plate_before, static))
            self.names.append(name)
            if (rgb == before).all() and not (plate_rgb == plate_before).all():
                report.findings.append(
                    Finding(
                        check="frozen", where=name, text="the frame repeats the one before, but its plate does not", value=1.0, limit=0.0
                    )
                )
        self._previous = rgb, plate_rgb

    def skip(self) -> None:
        """Note that a frame is missing: the next has nothing to be compared with."""
        self._previous = None

    def judge(self, report: CheckReport, limit: float) -> None:
        """Compare the mean over the film with the limit, and find single frames that differ from their neighbours."""
        if not self.changes:
            return
        score, own = float(np.mean(self.changes)), float(np.mean(self.own_changes))
        report.measures |= {"flicker": score, "flicker of the plate": own}
        if score - own > limit:
            text = (
                f"the mean change between frames where the plate stands still is {score:.3%}, the plate's own {own:.3%}; "
                f"virtual things that move there count too"
            )
            report.findings.append(Finding(check="flicker", where="all frames", text=text, value=score - own, limit=limit))
        self._judge_pops(report, limit)

    def _judge_pops(self, report: CheckReport, limit: float) -> None:
        beyond = np.maximum(np.array(self.changes) - np.array(self.own_changes), 0.0)
        if len(beyond) + 1 < _LEAST_FRAMES:
            return
        for index, change in enumerate(beyond):
            low, high = max(index - _NEIGHBOURS, 0), index + _NEIGHBOURS + 1
            usual = float(np.median(np.delete(beyond[low:high], index - low)))
            if change > limit + _POP_FACTOR * usual:
                text = f"the change from the frame before is {change:.3%}, around it {usual:.3%}"
                report.findings.append(
                    Finding(check="pop", where=self.names[index], text=text, value=float(change), limit=limit + _POP_FACTOR * usual)
                )
