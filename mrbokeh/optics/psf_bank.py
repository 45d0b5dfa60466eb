"""PsfBank: every kernel of a lens that a renderer may need, sampled over a few physical coordinates (Axis)."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, Literal, get_args

import numpy as np
from jaxtyping import Float, Float32, Float64, Int64

from mrbokeh.optics.psf_grid import NestedGrid, ProportionalGrid
from mrbokeh.system.errors import InputError

AxisName = Literal["diameter_px", "motion_px", "depth_m", "eccentricity", "field_x", "field_y"]
_SIGNED = ("diameter_px", "field_x", "field_y")


@dataclass(frozen=True)
class Axis:
    """Coordinate of a space of PSFs and how its range is mapped to 0..1 (power remapping, Leimkuehler 2018, Section 5.2).

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
        """Return whether the two sides of the focus, or of the frame, are kept apart."""
        return bool(self.low < 0.0)

    def to_unit(self, coordinate: Float[np.ndarray, "*batch"] | float) -> Float64[np.ndarray, "*batch"]:
        """Convert a physical to a unit coordinate; values beyond the range go to its nearer end."""
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
        """Convert a unit (0..1) to a physical coordinate, the inverse of `to_unit`."""
        value = np.asarray(unit, np.float64)
        if self.is_signed:
            share = 2.0 * value - 1.0
            return np.asarray(self.high * np.copysign(np.abs(share) ** self.exponent, share))
        return self.between(self.low, self.high, value**self.exponent)

    def between(self, low: float, high: float, share: Float[np.ndarray, "*batch"] | float) -> Float64[np.ndarray, "*batch"]:
        """Return the coordinate at a share (0..1) of the way from low to high, in metres, pixels or, if the axis says so, dioptres."""
        part = np.asarray(share, np.float64)
        if self.in_dioptres:
            dioptres = 1.0 / low + part * (1.0 / high - 1.0 / low)
            return np.divide(1.0, dioptres, out=np.full(part.shape, np.inf), where=dioptres > 0.0)
        return np.asarray(low + part * (high - low))


Turns = Literal["none", "motion", "field"]
Kernel = Float32[np.ndarray, "size size channels"]
Grid = NestedGrid | ProportionalGrid

_MOST_LIGHT = 1.001
"""Largest sum of a kernel: 1, but for the rounding of float32."""


@dataclass(frozen=True, eq=False)
class PsfBank:
    """Kernels of the cells of a grid over a few coordinates, from a model (mrbokeh.psf_models) or a measured lens.

    model: name of what made it. axes: the coordinates; counts: steps of the grid along each (`NestedGrid`).
    kernels: one per cell, (K, K, C) float32, K odd and its own for each, C 1 or 3; rows go down, columns right, the source
    in the middle pixel: what falls from a point into each pixel (renderers see to it that a pixel is no point: see
    mrbokeh.optics.drawn_diameters). Each stands for the whole of its cell. A channel sums to 1, or to less where light is absorbed
    (`throughput`); a renderer then darkens the picture by that much.
    turns: what a kernel is turned by where it is used, from x towards y: "motion", the kernels are those of motion to the
    right; "field", of a source to the right of the middle of the frame; "none".
    near_side_turned: kernels are those behind the focus; in front (negative diameter) they are turned by half a turn.
    nested: False is a regular grid, as for a single axis, signed diameters or samples that were measured on one.
    knee_px: not None makes it neither, but a `ProportionalGrid` with this knee, over two linear axes in pixels.
    settings: how it was made, as JSON values.
    """

    model: str
    axes: tuple[Axis, ...]
    counts: tuple[int, ...]
    kernels: tuple[np.ndarray, ...]
    turns: str = "none"
    near_side_turned: bool = False
    nested: bool = True
    settings: Mapping[str, Any] = field(default_factory=dict)
    knee_px: float | None = None

    def __post_init__(self) -> None:
        check_space(self.axes, self.counts, self.nested, self.turns)
        if len(self.kernels) != len(self.grid):
            raise InputError(f"a bank of {len(self.grid)} cells needs as many kernels, but came with {len(self.kernels)}")
        channels = {kernel.shape[-1] for kernel in self.kernels}
        if len(channels) != 1 or not channels <= {1, 3}:
            raise InputError(f"the kernels of a bank must all have 1 or all have 3 channels, but came with {sorted(channels)}")
        for index, kernel in enumerate(self.kernels):
            check_kernel(kernel, f"kernel {index}")

    @cached_property
    def grid(self) -> Grid:
        return grid_over(self.axes, self.counts, self.nested, self.knee_px)

    @property
    def channels(self) -> int:
        return int(self.kernels[0].shape[-1])

    @property
    def radius_px(self) -> int:
        """Return the whole pixels from the centre to the border of the largest kernel."""
        return max(kernel.shape[0] for kernel in self.kernels) // 2

    @cached_property
    def throughput(self) -> Float64[np.ndarray, "cells channels"]:
        """Return the sum of each kernel, 1 if no light is absorbed."""
        return np.stack([kernel.sum(axis=(0, 1), dtype=np.float64) for kernel in self.kernels])

    @cached_property
    def boxes(self) -> Float64[np.ndarray, "cells axes 2"]:
        """Return the low and high end of each cell on each axis, in physical coordinates."""
        return physical_boxes(self.axes, self.grid)

    @cached_property
    def centres(self) -> Float64[np.ndarray, "cells axes"]:
        """Return the middle of each cell, in physical coordinates."""
        ends = [[axis.between(low, high, 0.5) for axis, (low, high) in zip(self.axes, box, strict=True)] for box in self.boxes]
        return np.array(ends, np.float64)

    def nearest(self, coords: Float[np.ndarray, "*batch axes"]) -> Int64[np.ndarray, "*batch"]:
        """Return the cells whose kernels stand for these physical coordinates; found in constant time."""
        unit = np.stack([axis.to_unit(coords[..., index]) for index, axis in enumerate(self.axes)], axis=-1)
        return self.grid.index_of(unit)

    def kernel_at(self, coords: Float[np.ndarray, " axes"]) -> Kernel:
        """Return the kernel for one point, in front of the focus turned if the bank says so; not turned by motion or field."""
        kernel = self.kernels[int(self.nearest(np.asarray(coords, np.float64)))]
        in_front = any(axis.name == "diameter_px" and value < 0.0 for axis, value in zip(self.axes, coords, strict=True))
        return kernel[::-1, ::-1] if in_front and self.near_side_turned else kernel


def grid_over(axes: tuple[Axis, ...], counts: tuple[int, ...], nested: bool, knee_px: float | None) -> Grid:
    """Return the grid of a bank, in unit coordinates of its axes."""
    if knee_px is None:
        return NestedGrid(counts, nested)
    if any(axis.low != 0.0 or axis.exponent != 1.0 or not axis.name.endswith("_px") for axis in axes):
        raise InputError("a proportional grid needs linear axes in pixels that begin at 0 (exponent 1): it bends them itself")
    return ProportionalGrid(counts, tuple(axis.high for axis in axes), knee_px)


def check_space(axes: tuple[Axis, ...], counts: tuple[int, ...], nested: bool, turns: str) -> None:
    """Refuse axes, counts and turns that make no space of PSFs."""
    names = [axis.name for axis in axes]
    if not axes or len(axes) != len(counts) or len(set(names)) != len(names):
        raise InputError(f"each axis of a bank must appear once and have one count, got {names} and {counts}")
    if nested and any(axis.is_signed for axis in axes):
        raise InputError("a bank over signed coordinates needs a regular grid (nested=False): a nested one is fine at one end only")
    if turns not in get_args(Turns):
        raise InputError(f"a bank turns by one of {', '.join(get_args(Turns))}, got {turns!r}")


def check_kernel(kernel: np.ndarray, where: str) -> None:
    """Refuse an array that is no kernel: (K, K, C), K odd, finite, no channel brighter than its source or black."""
    if kernel.ndim != 3 or kernel.shape[0] != kernel.shape[1] or kernel.shape[0] % 2 == 0 or kernel.dtype != np.float32:
        raise InputError(f"{where}: expected (K, K, C) float32 with an odd K, got {kernel.shape} {kernel.dtype}")
    light = kernel.sum(axis=(0, 1), dtype=np.float64)
    if not ((light > 0.0) & (light <= _MOST_LIGHT)).all():
        raise InputError(f"{where}: each channel of a kernel must sum to 1, or to less where light is absorbed, got {light.tolist()}")


def physical_boxes(axes: tuple[Axis, ...], grid: Grid) -> Float64[np.ndarray, "cells axes 2"]:
    """Return the cells of a grid in physical coordinates."""
    return np.stack([axis.from_unit(grid.boxes[:, index]) for index, axis in enumerate(axes)], axis=1)
