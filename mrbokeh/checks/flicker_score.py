"""Flicker: how much a film changes from frame to frame where its plate stands still, beyond what the plate does itself."""

from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Bool, Float32

from mrbokeh.checks.findings import CheckReport, Finding

Rgb = Float32[np.ndarray, "height width 3"]

_NOISE_SIGMAS = 5.0
_LEAST_STATIC = 2e-3
_POP_FACTOR = 6.0
_NEIGHBOURS = 4
_LEAST_FRAMES = 6


def static_pixels(plate_rgb: Rgb, previous_rgb: Rgb) -> Bool[np.ndarray, "height width"]:
    """(H, W) where the plate changes by no more than its own noise, which is measured as the median change."""
    change = np.abs(np.clip(plate_rgb, 0, 1) - np.clip(previous_rgb, 0, 1)).max(axis=2)
    return change <= max(_LEAST_STATIC, _NOISE_SIGMAS * float(np.median(change)) / 0.6745)


def mean_change(rgb: Rgb, previous_rgb: Rgb, where: Bool[np.ndarray, "height width"]) -> float:
    """Mean absolute difference of linear light clipped to [0, 1]; 0 where nothing is asked for."""
    if not where.any():
        return 0.0
    return float(np.abs(np.clip(rgb[where], 0, 1) - np.clip(previous_rgb[where], 0, 1)).mean(dtype=np.float64))


@dataclass
class FlickerScore:
    """Frames go in one by one; two are held."""

    changes: list[float] = field(default_factory=list)
    own_changes: list[float] = field(default_factory=list)
    names: list[str] = field(default_factory=list)
    _previous: tuple[Rgb, Rgb] | None = None

    def add(self, report: CheckReport, name: str, rgb: Rgb, plate_rgb: Rgb) -> None:
        """plate_rgb: the same frame of the plate."""
        rgb = np.nan_to_num(rgb, posinf=1.0, neginf=0.0)
        if self._previous is not None:
            before, plate_before = self._previous
            static = static_pixels(plate_rgb, plate_before)
            self.changes.append(mean_change(rgb, before, static))
            self.own_changes.append(mean_change(plate_rgb, plate_before, static))
            self.names.append(name)
            if (rgb == before).all() and not (plate_rgb == plate_before).all():
                report.findings.append(Finding("frozen", name, "the frame repeats the one before, but its plate does not", 1.0, 0.0))
        self._previous = rgb, plate_rgb

    def skip(self) -> None:
        """A frame is missing: the next has nothing to be compared with."""
        self._previous = None

    def judge(self, report: CheckReport, limit: float) -> None:
        """The mean over the film against the limit, and single frames that jump out of their neighbours."""
        if not self.changes:
            return
        score, own = float(np.mean(self.changes)), float(np.mean(self.own_changes))
        report.measures |= {"flicker": score, "flicker of the plate": own}
        if score - own > limit:
            text = f"the mean change between frames where the plate stands still is {score:.3%}, the plate's own {own:.3%}"
            report.findings.append(Finding("flicker", "all frames", text, score - own, limit))
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
                report.findings.append(Finding("pop", self.names[index], text, float(change), limit + _POP_FACTOR * usual))
