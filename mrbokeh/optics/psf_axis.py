"""Axis: a physical coordinate of point spread functions, and how finely it is sampled where."""

from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np
from jaxtyping import Float, Float64

from mrbokeh.system.errors import InputError

AxisName = Literal["diameter_px", "motion_px", "depth_m", "eccentricity", "field_x", "field_y"]
_SIGNED = ("diameter_px", "field_x", "field_y")


@dataclass(frozen=True)
class Axis:
    """One coordinate of a space of PSFs and how its range is mapped to 0..1 (power remapping, Leimkuehler 2018, Section 5.2).

    With the share x of the range at which a coordinate lies, its unit coordinate is x ** (1 / exponent): equal steps of the
    unit coordinate are steps of x that grow for exponent > 1, so small coordinates are sampled more finely (the beta of the
    paper's Table 1).

    name: diameter_px, the circle of confusion (diameter); motion_px, path per shutter; depth_m, along the optical axis;
    eccentricity, distance from the middle of the frame in half diagonals; field_x and field_y, how far right and down of it.
    A diameter axis that begins at 0 or above serves both sides of the focus: its coordinates are taken without their sign.
    One from -high to high keeps the sides apart; its unit coordinate is 1/2 in focus and fine on both sides of it.
    in_dioptres: the share is one of 1 / depth, in which the circle of confusion is linear; `high` may then be inf.
    """

    name: str
    low: float
    high: float
    exponent: float = 1.0
    in_dioptres: bool = False

    def __post_init__(self) -> None:
        if self.name not in get_args(AxisName):
            raise InputError(f"expected an axis out of {', '.join(get_args(AxisName))}, got {self.name!r}")
        if not (self.low < self.high and (np.isfinite(self.high) or self.in_dioptres) and np.isfinite(self.low)):
            raise InputError(f"the axis {self.name} needs a range of finite numbers, low before high, got {self.low} to {self.high}")
        if not (np.isfinite(self.exponent) and self.exponent > 0.0):
            raise InputError(f"the axis {self.name} needs a positive exponent, got {self.exponent}")
        if self.in_dioptres and not self.low > 0.0:
            raise InputError(f"a depth in dioptres needs a range that begins above 0 m, got {self.low}")
        if self.low < 0.0 and (self.name not in _SIGNED or self.low != -self.high):
            raise InputError(
                f"only diameter_px may be negative, and field_x and field_y, and then from -high to high, got {self.name} {self.low} to "
                f"{self.high}"
            )

    @property
    def is_signed(self) -> bool:
        """Whether the two sides of the focus, or of the frame, lie apart."""
        return bool(self.low < 0.0)

    def to_unit(self, coordinate: Float[np.ndarray, "*batch"] | float) -> Float64[np.ndarray, "*batch"]:
        """Physical to unit coordinate; what lies beyond the range goes to its nearer end."""
        value = np.asarray(coordinate, np.float64)
        if self.is_signed:
            share = np.clip(value / self.high, -1.0, 1.0)
            return np.asarray(0.5 + 0.5 * np.copysign(np.abs(share) ** (1.0 / self.exponent), share))
        value = np.clip(np.abs(value) if self.name == "diameter_px" else value, self.low, self.high)
        if self.in_dioptres:
            share = (1.0 / self.low - 1.0 / value) / (1.0 / self.low - 1.0 / self.high)
        else:
            share = (value - self.low) / (self.high - self.low)
        return np.asarray(np.clip(share, 0.0, 1.0) ** (1.0 / self.exponent))

    def from_unit(self, unit: Float[np.ndarray, "*batch"] | float) -> Float64[np.ndarray, "*batch"]:
        """Unit (0..1) to physical coordinate, the inverse of `to_unit`."""
        value = np.asarray(unit, np.float64)
        if self.is_signed:
            share = 2.0 * value - 1.0
            return np.asarray(self.high * np.copysign(np.abs(share) ** self.exponent, share))
        return self.between(self.low, self.high, value**self.exponent)

    def between(self, low: float, high: float, share: Float[np.ndarray, "*batch"] | float) -> Float64[np.ndarray, "*batch"]:
        """The coordinate at a share (0..1) of the way from low to high, in metres, pixels or, where the axis says so, dioptres."""
        part = np.asarray(share, np.float64)
        if self.in_dioptres:
            dioptres = 1.0 / low + part * (1.0 / high - 1.0 / low)
            return np.divide(1.0, dioptres, out=np.full(part.shape, np.inf), where=dioptres > 0.0)
        return np.asarray(low + part * (high - low))
