"""Charts as inline SVG: numbers per slice, as lines or bars, with the band in which they should lie."""

import html
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

WIDTH, HEIGHT = 380.0, 200.0
_LEFT, _RIGHT, _TOP, _BOTTOM = 52.0, 10.0, 26.0, 34.0
_COLOURS = ("#1f6fb2", "#c4541b", "#3a8f4d", "#7d4fa8")


@dataclass(frozen=True)
class Axes:
    """What a chart shows. band: (low, high) of the y axis that is right, drawn in green; None for no such thing."""

    title: str
    x_label: str
    y_label: str
    band: tuple[float, float] | None = None


def chart(axes: Axes, x: Sequence[float], lines: Mapping[str, Sequence[float]], *, bars: bool = False) -> str:
    """lines: y values by name; None and values that are not finite are left out."""
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


@dataclass(frozen=True)
class _Frame:
    """What of the numbers is drawn."""

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
