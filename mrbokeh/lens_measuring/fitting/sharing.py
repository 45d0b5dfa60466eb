"""Sharing: colours, ranges of diameters or sides of the focus that have one picture of the pupil in common.

What is shared is measured from the evidence of all that share it, with less noise, and costs renderers less. Whether a lens may be
described so is asked of slices that the fit has not seen: the simplest description is taken that is no worse than the best one, within the
standard error of their difference (Breiman et al. 1984, Section 3.4.3: the one-standard-error rule).
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float64

from mrbokeh.lens_measuring.fitting.evidence import Evidence
from mrbokeh.lens_measuring.fitting.knots import Knots


@dataclass(frozen=True)
class Sharing:
    """Which pictures are one and the same."""

    colours: bool = False
    diameters: bool = False
    sides: bool = False

    def merged(self, evidence: Evidence, knots: Knots) -> tuple[Evidence, Knots]:
        """The evidence of those that share, and the knots that are left; sides stay two, each with the evidence of both."""
        fewer = replace(knots, diameters_px=knots.diameters_px[:1]) if self.diameters else knots

        def summed(of_knots: np.ndarray, with_channels: bool) -> np.ndarray:
            whole = of_knots.reshape(*knots.shape, *of_knots.shape[1:])
            whole = whole.sum(axis=1, keepdims=True) if self.diameters else whole
            whole = whole.sum(axis=3, keepdims=True) if self.colours and with_channels else whole
            both = np.broadcast_to(whole.sum(axis=0, keepdims=True), whole.shape) if self.sides else whole
            return both.reshape(len(fewer), *both.shape[3:])

        channels = (summed(each, True) for each in (evidence.matrices, evidence.sides))
        return Evidence(*channels, *(summed(each, False) for each in (evidence.energies, evidence.counts))), fewer

    def spread(
        self, pictures: Float64[np.ndarray, "fewer shared cells"], knots: Knots, channels: int
    ) -> Float64[np.ndarray, "knots channels cells"]:
        """Those of all knots and colours, from those of `merged`."""
        shape = (2, -1, knots.fields, *pictures.shape[1:])
        whole = np.broadcast_to(pictures.reshape(shape), (*knots.shape, channels, pictures.shape[-1]))
        return np.ascontiguousarray(whole.reshape(len(knots), channels, -1))


NOTHING = Sharing()
SIMPLEST_FIRST = (
    Sharing(colours=True, diameters=True, sides=True),
    Sharing(colours=True, diameters=True),
    Sharing(colours=True, sides=True),
    Sharing(colours=True),
)
"""Sharings that are tried, from the one with the fewest pictures to that with the most."""


def simplest_of(errors: Sequence[Sequence[float]]) -> int:
    """The first description, of those given from the simplest on, that is no worse than the best. errors: of each, slice by slice."""
    squares = np.square(np.asarray(errors, np.float64))
    if squares.size == 0:
        return len(squares) - 1
    worse = squares - squares[squares.sum(axis=1).argmin()]
    deviation = worse.std(axis=1, ddof=1) if squares.shape[1] > 1 else np.zeros(len(squares))
    return int(np.argmax(worse.mean(axis=1) <= deviation / np.sqrt(squares.shape[1])))
