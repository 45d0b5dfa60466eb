"""Knots: the places over side of the focus, diameter and field at which a lens is measured."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Float64, Int64

from mrbokeh.system.errors import InputError

_FARTHEST = 1.0  # half diagonals: a corner


@dataclass(frozen=True)
class Knots:
    """Where kernels are solved for. Each stands for what is nearest to it; in front of the focus come first, then diameters, then places.

    diameters_px: ascending, above 0, the middles of the ranges of diameters (in proportion) whose kernels share a shape.
    regions: columns and rows into which the frame is cut. rings: more than 0 makes the lens symmetric instead: so many ranges of
    eccentricity, the kernels of each those of a source to the right of the middle, turned with the place.
    highs: how far the frame reaches right and down of its middle, in half diagonals.
    """

    diameters_px: tuple[float, ...]
    regions: tuple[int, int] = (1, 1)
    rings: int = 0
    highs: tuple[float, float] = (0.832, 0.555)

    def __post_init__(self) -> None:
        steps = np.diff([0.0, *self.diameters_px])
        if not self.diameters_px or not (steps > 0.0).all() or not np.isfinite(self.diameters_px).all():
            raise InputError(f"expected diameters in px that grow from above 0, such as 10 20, got {self.diameters_px}")
        if min(self.regions) < 1 or self.rings < 0:
            raise InputError(f"expected at least 1x1 regions of the frame, got {self.regions[0]}x{self.regions[1]}")

    @property
    def fields(self) -> int:
        """How many parts of the field are told apart."""
        return self.rings or self.regions[0] * self.regions[1]

    def __len__(self) -> int:
        return 2 * len(self.diameters_px) * self.fields

    @property
    def shape(self) -> tuple[int, int, int]:
        """Sides, diameters, parts of the field."""
        return 2, len(self.diameters_px), self.fields

    def fields_at(self, field_xy: Float[np.ndarray, "*batch 2"]) -> Int64[np.ndarray, "*batch"]:
        """The part of the field of each position; regions row by row."""
        if self.rings:
            shares = np.hypot(field_xy[..., 0], field_xy[..., 1]) / _FARTHEST
            return np.asarray(np.clip((shares * self.rings).astype(np.int64), 0, self.rings - 1))
        steps = [np.clip((0.5 + 0.5 * field_xy[..., i] / self.highs[i]) * self.regions[i], 0, self.regions[i] - 1) for i in (0, 1)]
        return np.asarray(steps[1].astype(np.int64) * self.regions[0] + steps[0].astype(np.int64))

    def at(self, coc_px: Float[np.ndarray, "*batch"], field_xy: Float[np.ndarray, "*batch 2"]) -> Int64[np.ndarray, "*batch"]:
        """The knot of a signed diameter at a position."""
        middles = np.sqrt(np.array(self.diameters_px[:-1]) * np.array(self.diameters_px[1:]))
        step = np.searchsorted(middles, np.abs(coc_px))
        return np.asarray(((np.asarray(coc_px) > 0) * len(self.diameters_px) + step) * self.fields + self.fields_at(field_xy))

    def turns(self, field_xy: Float[np.ndarray, "points 2"]) -> Float64[np.ndarray, "points 2"]:
        """Cosine and sine of the angle by which kernels are turned at each position: none unless the lens is symmetric."""
        angles = np.arctan2(field_xy[:, 1], field_xy[:, 0]) * bool(self.rings)
        return np.stack([np.cos(angles), np.sin(angles)], axis=1)

    def neighbours(self) -> dict[str, Int64[np.ndarray, "pairs 2"]]:
        """Pairs of knots that differ by one step of "diameter" or "field", or by "side" alone."""
        numbers = np.arange(len(self)).reshape(self.shape)
        across = numbers.reshape(*self.shape[:2], 1, -1) if self.rings else numbers.reshape(*self.shape[:2], *self.regions[::-1])
        field = [_pairs(across, axis) for axis in (2, 3)]
        return {"side": _pairs(numbers, 0), "diameter": _pairs(numbers, 1), "field": np.concatenate(field)}


def _pairs(numbers: Int64[np.ndarray, "..."], axis: int) -> Int64[np.ndarray, "pairs 2"]:
    ordered = np.moveaxis(numbers, axis, 0)
    return np.stack([ordered[:-1].ravel(), ordered[1:].ravel()], axis=1)
