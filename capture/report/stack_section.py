"""One stack on the page: its gates, curves over the slices, and pictures."""

import html
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from capture.report.charts import Axes, chart
from capture.report.findings import StackFindings
from capture.report.gates import Gate, counts
from capture.report.kept_examination import KeptPicture, KeptPlace
from capture.report.stack_rules import LARGEST_BLUR_GAIN, LARGEST_EXPOSURE, LARGEST_FOCUS_PX, LEAST_DB
from mrbokeh.system.html_page import cell, table

_MARKS = {"passed": ("met", "✓"), "failed": ("missed", "✗"), "absent": ("muted", "–")}


@dataclass(frozen=True)
class ExaminedStack:
    """Findings, verdicts and pictures, which stay on disk. reused: whether they were there already."""

    findings: StackFindings
    gates: Sequence[Gate]
    pictures: Sequence[KeptPicture] = ()
    places: Sequence[KeptPlace] = ()
    reused: bool = False

    @property
    def failures(self) -> int:
        return sum(each.failed for each in self.gates)


def gate_table(gates: Sequence[Gate], *, with_place: bool = False) -> str:
    """with_place: names the stack too, for gates of several."""
    rows = []
    for each in gates:
        kind, mark = _MARKS[str(each.verdict)]
        name = f"{each.where}: {each.name}" if with_place else each.name
        why = f"{each.why} {each.advice}" if each.failed else each.why
        verdict = cell(f"{mark}\N{NO-BREAK SPACE}{each.verdict}", kind)
        rows.append((verdict, cell(name, "name"), cell(each.measured), cell(each.limit, "wanted"), cell(why, "why")))
    return f'<div class="gates">{table(("verdict", "gate", "measured", "wanted", "why, and what to do"), rows)}</div>'


def stack_section(examined: ExaminedStack, *, with_pictures: bool) -> str:
    findings = examined.findings
    summary = f"{html.escape(findings.name)}: {len(findings.slices)} slices, {html.escape(counts(examined.gates))}"
    pictures = "".join(each.html() for each in examined.pictures) if with_pictures else ""
    places = place_section(examined) if with_pictures else ""
    body = gate_table(examined.gates) + places + f'<div class="charts">{"".join(charts(findings))}</div>' + pictures
    opened = " open" if with_pictures else ""
    return f'<details{opened} id="{html.escape(findings.name)}"><summary><b>{summary}</b></summary>{body}</details>'


def place_section(examined: ExaminedStack) -> str:
    """Crops of the worst places, by gate."""
    parts = []
    for gate in examined.gates:
        places = [each for each in examined.places if each.gate == gate.name]
        if places:
            parts.append(f'<h3>{html.escape(gate.name)}: <span class="{_MARKS[str(gate.verdict)][0]}">{gate.verdict}</span></h3>')
            parts += [f'<div class="place"><p>{html.escape(each.caption)}</p>{_crops(each)}</div>' for each in places]
    if not parts:
        return ""
    return '<p class="muted">The worst places, pixel by pixel; pictures of one row show the same pixels.</p>' + "".join(parts)


def _crops(place: KeptPlace) -> str:
    return "".join(each.html() for each in place.pictures)


def charts(findings: StackFindings) -> list[str]:
    """Over dioptres where focus distances are known, else over the number of the slice."""
    spacing = findings.spacing
    x: Sequence[float] = spacing.focus_dioptres if spacing else [float(each.index) for each in findings.slices]
    label = "focus [dioptres]" if spacing else "slice"
    return [*_focus_charts(findings, x, label), *_prediction_charts(findings, x, label), *_drift_charts(findings)]


def _focus_charts(findings: StackFindings, x: Sequence[float], label: str) -> list[str]:
    gains = np.array([each.gain for each in findings.slices])
    typical = np.nanmedian(gains) if np.isfinite(gains).any() else 1.0
    drawn = [chart(Axes("Brightness against the median", label, "%", (-2.0, 2.0)), x, {"gain": (100 * (gains / typical - 1)).tolist()})]
    shares = {"share": (100.0 * findings.curve.shares).tolist()}
    return [chart(Axes("Where things are sharp", label, "% of trusted pixels"), x, shares, bars=True), *drawn]


def _prediction_charts(findings: StackFindings, x: Sequence[float], label: str) -> list[str]:
    fits = [each.fit for each in findings.slices if each.fit is not None]
    if len(fits) < len(findings.slices):
        return []
    decibels = {"re-blurred": [each.psnr_db for each in findings.slices], "without blur": [each.unblurred_db for each in findings.slices]}
    known = {name: [float("nan") if value is None else value for value in values] for name, values in decibels.items()}
    off = LARGEST_FOCUS_PX
    gain, light = 100 * LARGEST_BLUR_GAIN, 100 * LARGEST_EXPOSURE
    return [
        chart(Axes("Re-blurred against photographed", label, "dB", (LEAST_DB, LEAST_DB + 15.0)), x, known),
        chart(Axes("Circles of confusion off by", label, "px", (-off, off)), x, {"focus": [each.focus_px.value for each in fits]}),
        chart(Axes("Blur larger than predicted", label, "%", (-gain, gain)), x, {"blur": [100 * each.blur_gain.value for each in fits]}),
        chart(Axes("Brighter than predicted", label, "%", (-light, light)), x, {"light": [100 * each.exposure.value for each in fits]}),
    ]


def _drift_charts(findings: StackFindings) -> list[str]:
    drift = findings.drift
    if drift is None:
        return []
    slices = [float(each) for each in range(len(drift.shift_px))]
    shift = {"right": drift.shift_px[:, 0].tolist(), "down": drift.shift_px[:, 1].tolist()}
    return [
        chart(Axes("Registration: shift", "slice", "px"), slices, shift),
        chart(Axes("Registration: enlarged by", "slice", "%"), slices, {"scale": (100 * (drift.magnification - 1)).tolist()}),
        chart(Axes("Registration: turned by", "slice", "degrees"), slices, {"turn": np.rad2deg(drift.rotation_rad).tolist()}),
    ]
