"""A round stop in a round opening that changes across the frame: rings that are thick on the left, thin in the middle, open on the right.

The circle bokeh of Neural Bokeh (Mandl et al. 2024, section 4.2) looks so. An aperture's outlines cannot say it, since they are the
same everywhere but for the cat-eye's rim.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from jaxtyping import Float

from mrbokeh.optics.aperture import Aperture
from mrbokeh.optics.aperture_shapes import joined, net_area, outlines_of, unit_disc
from mrbokeh.system.errors import InputError

_LINES = 512
_TABLE_COLUMNS, _TABLE_ROWS = 65, 49
_TABLE_REACH = 1.25


@dataclass(frozen=True)
class FieldStop:
    """Everything in radii of the unit pupil; x is the field position, in half diagonals.

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
        """(radius, shift to the right) at field positions x, arrays of NumPy or, with its own minimum and maximum, of Dr.Jit."""
        share = field_x * (1.0 / self.edge)
        left, right = minimum(maximum(-share, 0.0), 1.0), minimum(maximum(share, 0.0), 1.0)
        return self.radius + (self.radius_left - self.radius) * left, self.shift_right * right

    def seen(self, round_opening: Aperture, field_xy: tuple[float, float]) -> Aperture:
        """The plain aperture that a point at a place of the frame sees, as polygons; round_opening with its cat-eye."""
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
        """Rows: |y| from 0, columns: x from -reach, both to reach, evenly spaced."""
        x = np.linspace(-_TABLE_REACH, _TABLE_REACH, _TABLE_COLUMNS)
        return np.array([[self.exactly(float(each), float(y)) for each in x] for y in np.linspace(0.0, _TABLE_REACH, _TABLE_ROWS)])

    def exactly(self, field_x: float, field_y: float) -> float:
        """Lengths of the open spans on lines across the pupil, by the midpoint rule in the angle (dense towards the poles)."""
        angle = (np.arange(_LINES) + 0.5) * np.pi / _LINES
        y, line_height = -np.cos(angle), np.sin(angle) * np.pi / _LINES
        (left, right), (rim_left, rim_right) = _span(y, 0.0, 0.0, 1.0), _span(y, -self.cat_eye * field_x, -self.cat_eye * field_y, 1.0)
        left, right = np.maximum(left, rim_left), np.minimum(right, rim_right)
        radius, shift = self.stop.radius_and_shift(field_x)
        stop_left, stop_right = _span(y, shift, 0.0, radius)
        hidden = np.maximum(np.minimum(right, stop_right) - np.maximum(left, stop_left), 0.0)
        return float((np.maximum(right - left - hidden, 0.0) * line_height).sum() / np.pi)

    def places(self, field_x: Any, field_y: Any) -> tuple[Any, Any]:
        """(column, row) of a place in the table, still fractions; y counts without its sign."""
        step_x, step_y = 2.0 * _TABLE_REACH / (_TABLE_COLUMNS - 1), _TABLE_REACH / (_TABLE_ROWS - 1)
        return (field_x + _TABLE_REACH) * (1.0 / step_x), abs(field_y) * (1.0 / step_y)

    def at(self, field_x: Float[np.ndarray, " n"], field_y: Float[np.ndarray, " n"]) -> Float[np.ndarray, " n"]:
        """Bilinear in the table."""
        from scipy.ndimage import map_coordinates

        column, row = self.places(field_x, field_y)
        return map_coordinates(self.table, [row, column], order=1, mode="nearest")


def _span(y: Float[np.ndarray, " lines"], centre_x: float, centre_y: float, radius: float) -> tuple[np.ndarray, np.ndarray]:
    """(left, right) end of each line within a disc; left after right where it misses the disc."""
    half = np.sqrt(np.maximum(radius**2 - (y - centre_y) ** 2, 0.0))
    misses = np.abs(y - centre_y) >= radius
    return np.where(misses, np.inf, centre_x - half), np.where(misses, -np.inf, centre_x + half)


def polygon_share(aperture: Aperture) -> float:
    """Area of a plain aperture over that of the unit disc."""
    return net_area((aperture.outlines, aperture.weights)) / np.pi
