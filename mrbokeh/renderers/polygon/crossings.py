"""Corners of polygon_differences by the lattice points on which their edges' lines cross."""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from mrbokeh.renderers.polygon.directional_differences import Direction, PolygonCorners


@dataclass(frozen=True)
class CrossedCorner:
    """A corner whose four crossings lie at 0, step, step_after and their sum, lattice points in (x, y).

    turned, turned_after: whether the two lines of that edge count backwards, from the one farther along its step.
    """

    before: int
    after: int
    step: Direction
    step_after: Direction
    plane: int
    weight: float
    turned: bool = False
    turned_after: bool = False

    @property
    def kind(self) -> int:
        """0: crossings 0 and 1 are neighbours in a row, as are 2 and 3; 1: crossings 1 and 2 are; 2: none are."""
        if self.step == (1, 0):
            return 0
        return 1 if (self.step_after[0] - self.step[0], self.step_after[1] - self.step[1]) == (1, 0) else 2

    @property
    def variants(self) -> "Iterator[CrossedCorner]":
        """The same corner with its edges named the other way round, and with lines counted backwards."""
        other = replace(self, before=self.after, after=self.before, step=self.step_after, step_after=self.step)
        for corner in (self, other):
            step, step_after = ((-x, -y) for x, y in (corner.step, corner.step_after))
            yield corner
            yield replace(corner, step=step, turned=True)
            yield replace(corner, step_after=step_after, turned_after=True)
            yield replace(corner, step=step, turned=True, step_after=step_after, turned_after=True)

    @property
    def places(self) -> list[Direction]:
        """The crossings, in pairs as their weights are stored."""
        both = self.step[0] + self.step_after[0], self.step[1] + self.step_after[1]
        return [(0, 0), self.step, self.step_after, both] if self.kind == 0 else [self.step, self.step_after, (0, 0), both]


@dataclass(frozen=True)
class CrossedCorners:
    """CrossedCorner by CrossedCorner in arrays: steps (corners, 2, 2) and places (corners, 4, 2) in (x, y), turned (corners, 2);
    those of kind 0 come first, up to `level`, then those of kind 1, up to `steep`."""

    before: np.ndarray
    after: np.ndarray
    steps: np.ndarray
    places: np.ndarray
    plane: np.ndarray
    weight: np.ndarray
    turned: np.ndarray
    level: int
    steep: int

    @classmethod
    def of(cls, corners: list[CrossedCorner]) -> "CrossedCorners":
        return cls(
            before=_whole([corner.before for corner in corners]),
            after=_whole([corner.after for corner in corners]),
            steps=_whole([(corner.step, corner.step_after) for corner in corners]),
            places=_whole([corner.places for corner in corners]),
            plane=_whole([corner.plane for corner in corners]),
            weight=np.array([corner.weight for corner in corners]),
            turned=np.array([(corner.turned, corner.turned_after) for corner in corners]),
            level=sum(corner.kind == 0 for corner in corners),
            steep=sum(corner.kind <= 1 for corner in corners),
        )


def crossed_corners(corners: PolygonCorners, planes: dict[tuple[Direction, Direction], int]) -> CrossedCorners:
    """Corners with as many neighbouring crossings as they have, the best kinds first."""
    found = []
    for before, after, weight in zip(corners.before, corners.after, corners.weight, strict=True):
        first, second = corners.direction[before], corners.direction[after]
        det = int(first[0] * second[1] - first[1] * second[0])
        step, step_after = (det * second[0], det * second[1]), (-det * first[0], -det * first[1])
        pair = pair_of(corners, before, after)
        corner = CrossedCorner(before, after, step, step_after, planes[pair], weight if pair == (first, second) else -weight)
        found.append(min(corner.variants, key=lambda each: each.kind))
    return CrossedCorners.of(sorted(found, key=lambda corner: corner.kind))


def pair_of(corners: PolygonCorners, before: int, after: int) -> tuple[Direction, Direction]:
    first, second = sorted((corners.direction[before], corners.direction[after]))
    return first, second


def _whole(numbers: Any) -> np.ndarray:
    return np.array(numbers, np.int64)
