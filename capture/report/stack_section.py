"""Section of the page for one stack: its gates, curves over the slices as inline SVG, and pictures."""

import html
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from capture.report.findings import StackFindings
from capture.report.gates import LARGEST_BLUR_GAIN, LARGEST_EXPOSURE, LARGEST_FOCUS_PX, LEAST_DB, Gate, counts
from capture.report.report_cache import CachedPicture, CachedPlace
from mrbokeh.system.html_page import cell, table

WIDTH, HEIGHT = 380.0, 200.0
_LEFT, _RIGHT, _TOP, _BOTTOM = 52.0, 10.0, 26.0, 34.0
_COLOURS = ("#1f6fb2", "#c4541b", "#3a8f4d", "#7d4fa8")
_MARKS = {"passed": ("met", "✓"), "failed": ("missed", "✗"), "absent": ("muted", "–")}


@dataclass(frozen=True)
class ExaminedStack:
    """Findings, verdicts and pictures, which stay on disk. reused: whether they were there already."""

    findings: StackFindings
    gates: Sequence[Gate]
    pictures: Sequence[CachedPicture] = ()
    places: Sequence[CachedPlace] = ()
    reused: bool = False

    @property
    def failures(self) -> int:
        return sum(each.failed for each in self.gates)


def stack_section(examined: ExaminedStack, *, with_pictures: bool) -> str:
    findings = examined.findings
    summary = f"{html.escape(findings.name)}: {len(findings.slices)} slices, {html.escape(counts(examined.gates))}"
    pictures = "".join(each.html() for each in examined.pictures) if with_pictures else ""
    places = place_section(examined) if with_pictures else ""
    body = gate_table(examined.gates) + places + f'<div class="charts">{"".join(charts(findings))}</div>' + pictures
    opened = " open" if with_pictures else ""
    return f'<details{opened} id="{html.escape(findings.name)}"><summary><b>{summary}</b></summary>{body}</details>'


def gate_table(gates: Sequence[Gate], *, with_place: bool = False) -> str:
    """Return a table of gates. with_place: names the stack too, for gates of several."""
    rows = []
    for each in gates:
        kind, mark = _MARKS[str(each.verdict)]
        name = f"{each.where}: {each.name}" if with_place else each.name
        why = f"{each.why} {each.advice}" if each.failed else each.why
        verdict = cell(f"{mark}\N{NO-BREAK SPACE}{each.verdict}", kind)
        rows.append((verdict, cell(name, "name"), cell(each.measured), cell(each.limit, "wanted"), cell(why, "why")))
    return f'<div class="gates">{table(("verdict", "gate", "measured", "wanted", "why, and what to do"), rows)}</div>'


def place_section(examined: ExaminedStack) -> str:
    """Return crops of the worst places, by gate."""
    parts = []
    for gate in examined.gates:
        places = [each for each in examined.places if each.gate == gate.name]
        if places:
            parts.append(f'<h3>{html.escape(gate.name)}: <span class="{_MARKS[str(gate.verdict)][0]}">{gate.verdict}</span></h3>')
            parts += [f'<div class="place"><p>{html.escape(each.caption)}</p>{_crops(each)}</div>' for each in places]
    if not parts:
        return ""
    return '<p class="muted">The worst places, pixel by pixel; pictures of one row show the same pixels.</p>' + "".join(parts)


def _crops(place: CachedPlace) -> str:
    return "".join(each.html() for each in place.pictures)


def charts(findings: StackFindings) -> list[str]:
    """Draw over dioptres where focus distances are known, else over the number of the slice."""
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


@dataclass(frozen=True)
class Axes:
    """Texts of a chart. band: (low, high) of the y axis that is right, drawn in green; None for no such thing."""

    title: str
    x_label: str
    y_label: str
    band: tuple[float, float] | None = None


@dataclass(frozen=True)
class _Frame:
    """Range of numbers that is drawn."""

    x: tuple[float, float]
    y: tuple[float, float]

    @classmethod
    def around(cls, x: Sequence[float], y: Sequence[float], band: tuple[float, float] | None, *, from_zero: bool) -> "_Frame":
        low, high = min([*y, *(band or ()), *([0.0] if from_zero else [])]), max([*y, *(band or ())])
        room = 0.06 * (high - low) or 0.5
        side = 0.04 * (max(x) - min(x)) or 0.5
        return cls((min(x) - side, max(x) + side), (low if from_zero and low == 0 else low - room, high + room))

    def at(self, x: float, y: float) -> tuple[float, float]:
        """Return where a point is drawn, in units of the SVG."""
        right = _LEFT + (x - self.x[0]) / (self.x[1] - self.x[0]) * (WIDTH - _LEFT - _RIGHT)
        down = HEIGHT - _BOTTOM - (y - self.y[0]) / (self.y[1] - self.y[0]) * (HEIGHT - _TOP - _BOTTOM)
        return right, down


def chart(axes: Axes, x: Sequence[float], lines: Mapping[str, Sequence[float]], *, bars: bool = False) -> str:
    """Draw numbers per slice, as lines or bars. lines: y values by name; None and values that are not finite are left out."""
    finite = [value for values in lines.values() for value in values if _is_number(value)]
    if not finite or not x:
        return ""
    frame = _Frame.around(x, finite, axes.band, from_zero=bars)
    parts = [_band(frame, axes.band), _grid(frame), _labels(axes, frame)]
    for number, (name, values) in enumerate(lines.items()):
        colour = _COLOURS[number % len(_COLOURS)]
        points = [(a, b) for a, b in zip(x, values, strict=True) if _is_number(b)]
        parts.append(_bars(frame, points, colour) if bars else _line(frame, points, colour))
        if len(lines) > 1:
            parts.append(_text(_LEFT + 6 + 110 * number, _TOP - 2, name, fill=colour, size=11))
    return f'<svg viewBox="0 0 {WIDTH:g} {HEIGHT:g}" width="{WIDTH:g}" height="{HEIGHT:g}" role="img">{"".join(parts)}</svg>'


def _is_number(value: float | None) -> bool:
    return value is not None and abs(value) < float("inf")


def _band(frame: _Frame, band: tuple[float, float] | None) -> str:
    if band is None:
        return ""
    left, top = frame.at(frame.x[0], band[1])
    right, bottom = frame.at(frame.x[1], band[0])
    return f'<rect x="{left:.1f}" y="{top:.1f}" width="{right - left:.1f}" height="{bottom - top:.1f}" fill="#e3f3e6"/>'


def _grid(frame: _Frame) -> str:
    parts = []
    for share in (0.0, 0.5, 1.0):
        y = frame.y[0] + share * (frame.y[1] - frame.y[0])
        left, down = frame.at(frame.x[0], y)
        parts.append(f'<line x1="{left:.1f}" x2="{WIDTH - _RIGHT}" y1="{down:.1f}" y2="{down:.1f}" stroke="#ddd"/>')
        parts.append(_text(left - 4, down + 4, f"{y:.3g}", anchor="end"))
        x = frame.x[0] + share * (frame.x[1] - frame.x[0])
        parts.append(_text(frame.at(x, frame.y[0])[0], HEIGHT - _BOTTOM + 14, f"{x:.3g}", anchor="middle"))
    return "".join(parts)


def _labels(axes: Axes, frame: _Frame) -> str:
    middle = 0.5 * (frame.at(frame.x[0], 0.0)[0] + frame.at(frame.x[1], 0.0)[0])
    title = f"{axes.title} [{axes.y_label}]" if axes.y_label else axes.title
    return _text(4.0, 12.0, title, size=13, weight="bold") + _text(middle, HEIGHT - 4, axes.x_label, anchor="middle")


def _line(frame: _Frame, points: Sequence[tuple[float, float]], colour: str) -> str:
    places = [frame.at(*point) for point in points]
    path = " ".join(f"{x:.1f},{y:.1f}" for x, y in places)
    dots = "".join(f'<circle cx="{x:.1f}" cy="{y:.1f}" r="3" fill="{colour}"/>' for x, y in places)
    return f'<polyline points="{path}" fill="none" stroke="{colour}" stroke-width="1.5"/>{dots}'


def _bars(frame: _Frame, points: Sequence[tuple[float, float]], colour: str) -> str:
    width = 0.7 * (WIDTH - _LEFT - _RIGHT) / max(len(points) + 1, 2)
    ground = frame.at(0.0, max(frame.y[0], 0.0))[1]
    return "".join(
        f'<rect x="{x - width / 2:.1f}" y="{min(y, ground):.1f}" width="{width:.1f}" height="{abs(ground - y):.1f}" fill="{colour}"/>'
        for x, y in (frame.at(*point) for point in points)
    )


def _text(x: float, y: float, text: str, *, anchor: str = "start", size: int = 11, fill: str = "#444", weight: str = "normal") -> str:
    style = f'font-size="{size}" font-weight="{weight}" fill="{fill}" text-anchor="{anchor}" font-family="system-ui, sans-serif"'
    return f'<text x="{x:.1f}" y="{y:.1f}" {style}>{html.escape(text)}</text>'
