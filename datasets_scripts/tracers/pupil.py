"""Pupils of the truth tracer: even points in an aperture of any shape, and a round stop that changes across the frame.

The circle bokeh of Neural Bokeh (Mandl et al. 2024, section 4.2) needs the stop: rings that are thick on the left, thin in the
middle and open on the right. An aperture's outlines cannot say it, since they are the same everywhere but for the cat-eye's rim.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import Any

import numpy as np
from jaxtyping import Float, Float32

from mrbokeh.optics.aperture import Aperture
from mrbokeh.optics.aperture_shapes import joined, outlines_of, unit_disc
from mrbokeh.system.errors import InputError

_SCANLINES = 1 << 16
_BANDS = 1 << 14
_LINES = 512
_TABLE_COLUMNS, _TABLE_ROWS = 65, 49
_TABLE_REACH = 1.25


@dataclass(frozen=True, eq=False)
class PupilTable:
    """An aperture cut into horizontal bands of equal area.

    bands: (B, 2 + 2 S), y at the top and at the bottom of each band, then the S spans (left, right) of the aperture along the
    line that halves its area. A band is so thin (1/16384 of the area) that its slanted ends do not matter.
    """

    bands: Float32[np.ndarray, "bands columns"]

    @property
    def spans(self) -> int:
        return self.bands.shape[1] // 2 - 1

    def points(self, along: Float[np.ndarray, " n"], across: Float[np.ndarray, " n"]) -> Float[np.ndarray, "n 2"]:
        """Return (N, 2) points x, y: `across` chooses the band and the height within it, `along` the place on its spans."""
        scaled = across * len(self.bands)
        row = self.bands[np.minimum(scaled.astype(int), len(self.bands) - 1)].astype(np.float64)
        y = row[:, 0] + (scaled % 1.0) * (row[:, 1] - row[:, 0])
        widths = row[:, 3::2] - row[:, 2::2]
        left = along * widths.sum(axis=1)
        x = row[:, 2] + left
        for index in range(1, self.spans):
            left = left - widths[:, index - 1]
            x = np.where(left > 0, row[:, 2 + 2 * index] + left, x)
        return np.stack([x, y], axis=1)


@lru_cache(maxsize=8)
def pupil_table(aperture: Aperture) -> PupilTable:
    """Return the table of an aperture that passes all or nothing at every point: outlines of weight +1 and stops of weight -1."""
    if not all(abs(weight) == 1.0 for weight in aperture.weights):
        raise InputError(f"the ray tracer takes apertures that are open or closed (weights +1 and -1), got weights {aperture.weights}")
    every_y = np.concatenate([outline[:, 1] for outline in aperture.outlines])
    edges = np.linspace(every_y.min(), every_y.max(), _SCANLINES + 1)
    crossings = _crossings(aperture, 0.5 * (edges[1:] + edges[:-1]))
    area = np.concatenate([[0.0], np.cumsum((crossings[:, 1::2] - crossings[:, ::2]).sum(axis=1))])
    y = np.interp(np.linspace(0.0, area[-1], 2 * _BANDS + 1), area, edges)
    columns = [y[:-2:2, None], y[2::2, None], _crossings(aperture, y[1::2])]
    return PupilTable(np.concatenate(columns, axis=1).astype(np.float32))


def _crossings(aperture: Aperture, y: Float[np.ndarray, " rows"]) -> Float[np.ndarray, "rows crossings"]:
    """Return sorted x at which each line y enters and leaves the aperture; lines with fewer spans get empty ones."""
    found = []
    for outline in aperture.outlines:
        for (x0, y0), (x1, y1) in zip(outline, np.roll(outline, -1, axis=0), strict=True):
            inside = (y >= min(y0, y1)) & (y < max(y0, y1))
            slope = (x1 - x0) / (y1 - y0) if y1 != y0 else 0.0
            found.append(np.where(inside, x0 + slope * (y - y0), np.inf))
    crossings = np.sort(np.stack(found, axis=1), axis=1)
    finite = np.isfinite(crossings)
    crossings, finite = crossings[:, : finite.sum(axis=1).max()], finite[:, : finite.sum(axis=1).max()]
    last = np.max(np.where(finite, crossings, -np.inf), axis=1, keepdims=True)
    return np.where(finite, crossings, np.where(np.isfinite(last), last, 0.0))


@dataclass(frozen=True)
class FieldStop:
    """A round stop in a round opening, in radii of the unit pupil; x is the field position, in half diagonals.

    The stop is a disc of radius `radius` around the middle of the pupil. Towards the left edge of the frame (x = -edge) it shrinks to
    `radius_left`, towards the right edge it moves right by `shift_right`; in between it does so in proportion to x.
    """

    radius_left: float = 0.5
    radius: float = 0.8
    shift_right: float = 0.55
    edge: float = 0.87

    def __post_init__(self) -> None:
        if not (0.0 < self.radius_left < 1.0 and 0.0 < self.radius < 1.0 and 0.0 <= self.shift_right <= 1.0 and self.edge > 0.0):
            raise InputError(f"a stop needs radii between 0 and 1, a shift from 0 to 1 and an edge above 0, got {self}")

    def radius_and_shift(self, field_x: Any, minimum: Callable[..., Any] = np.minimum, maximum: Callable[..., Any] = np.maximum) -> Any:
        """Return (radius, shift to the right) at field positions x, arrays of NumPy or, with its own minimum and maximum, of Dr.Jit."""
        share = field_x * (1.0 / self.edge)
        left, right = minimum(maximum(-share, 0.0), 1.0), minimum(maximum(share, 0.0), 1.0)
        return self.radius + (self.radius_left - self.radius) * left, self.shift_right * right

    def seen(self, round_opening: Aperture, field_xy: tuple[float, float]) -> Aperture:
        """Return the plain aperture that a point at a place of the frame sees, as polygons; round_opening with its cat-eye."""
        from shapely import Polygon

        radius, shift = self.radius_and_shift(field_xy[0])
        stop = Polygon(radius * unit_disc() + np.array([shift, 0.0]))
        plain = round_opening.seen(1, field_xy)
        parts = [outlines_of(Polygon(outline) - stop, weight) for outline, weight in zip(plain.outlines, plain.weights, strict=True)]
        return Aperture(*joined(parts))


@dataclass(frozen=True)
class OpenShares:
    """The share of the unit disc that rim (cat_eye, see Aperture) and stop leave open, by place in the frame."""

    stop: FieldStop
    cat_eye: float

    @cached_property
    def table(self) -> Float[np.ndarray, "rows columns"]:
        """Return shares with rows |y| from 0 and columns x from -reach, both to reach, evenly spaced."""
        x = np.linspace(-_TABLE_REACH, _TABLE_REACH, _TABLE_COLUMNS)
        return np.array([[self.exactly(float(each), float(y)) for each in x] for y in np.linspace(0.0, _TABLE_REACH, _TABLE_ROWS)])

    def exactly(self, field_x: float, field_y: float) -> float:
        """Return the share from open spans on lines across the pupil, by the midpoint rule in the angle (dense towards the poles)."""
        angle = (np.arange(_LINES) + 0.5) * np.pi / _LINES
        y, line_height = -np.cos(angle), np.sin(angle) * np.pi / _LINES
        (left, right), (rim_left, rim_right) = _span(y, 0.0, 0.0, 1.0), _span(y, -self.cat_eye * field_x, -self.cat_eye * field_y, 1.0)
        left, right = np.maximum(left, rim_left), np.minimum(right, rim_right)
        radius, shift = self.stop.radius_and_shift(field_x)
        stop_left, stop_right = _span(y, shift, 0.0, radius)
        hidden = np.maximum(np.minimum(right, stop_right) - np.maximum(left, stop_left), 0.0)
        return float((np.maximum(right - left - hidden, 0.0) * line_height).sum() / np.pi)

    def places(self, field_x: Any, field_y: Any) -> tuple[Any, Any]:
        """Return (column, row) of a place in the table, still fractions; y counts without its sign."""
        step_x, step_y = 2.0 * _TABLE_REACH / (_TABLE_COLUMNS - 1), _TABLE_REACH / (_TABLE_ROWS - 1)
        return (field_x + _TABLE_REACH) * (1.0 / step_x), abs(field_y) * (1.0 / step_y)

    def at(self, field_x: Float[np.ndarray, " n"], field_y: Float[np.ndarray, " n"]) -> Float[np.ndarray, " n"]:
        """Return the shares, bilinear in the table."""
        from scipy.ndimage import map_coordinates

        column, row = self.places(field_x, field_y)
        return map_coordinates(self.table, [row, column], order=1, mode="nearest")


open_shares = lru_cache(maxsize=4)(OpenShares)


def _span(y: Float[np.ndarray, " lines"], centre_x: float, centre_y: float, radius: float) -> tuple[np.ndarray, np.ndarray]:
    """Return (left, right) end of each line within a disc; left after right where it misses the disc."""
    half = np.sqrt(np.maximum(radius**2 - (y - centre_y) ** 2, 0.0))
    misses = np.abs(y - centre_y) >= radius
    return np.where(misses, np.inf, centre_x - half), np.where(misses, -np.inf, centre_x + half)
