"""Evidence of a fit: the normal equations of many pixels, for every knot and colour, and which of them may share one picture.

Knots are the places over side of the focus, diameter and field at which a lens is measured. Colours, ranges of diameters or sides of the
focus may share a picture of the pupil: it is then measured with less noise, and costs renderers less. Whether a lens may be described so
is asked of slices that the fit has not seen: the simplest description is taken that is no worse than the best one, within the standard
error of their difference (Breiman et al. 1984, Section 3.4.3: the one-standard-error rule).
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float, Float32, Float64, Int64

from mrbokeh.system.errors import InputError

_FARTHEST = 1.0  # half diagonals: a corner


@dataclass(frozen=True)
class Knots:
    """Places at which kernels are solved for; each stands for what is nearest to it. The front of the focus comes first, then diameters,
    then
    places.

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
        """Return how many parts of the field are told apart."""
        return self.rings or self.regions[0] * self.regions[1]

    def __len__(self) -> int:
        return 2 * len(self.diameters_px) * self.fields

    @property
    def shape(self) -> tuple[int, int, int]:
        """Return sides, diameters, parts of the field."""
        return 2, len(self.diameters_px), self.fields

    def fields_at(self, field_xy: Float[np.ndarray, "*batch 2"]) -> Int64[np.ndarray, "*batch"]:
        """Return the part of the field of each position; regions row by row."""
        if self.rings:
            shares = np.hypot(field_xy[..., 0], field_xy[..., 1]) / _FARTHEST
            return np.asarray(np.clip((shares * self.rings).astype(np.int64), 0, self.rings - 1))
        steps = [np.clip((0.5 + 0.5 * field_xy[..., i] / self.highs[i]) * self.regions[i], 0, self.regions[i] - 1) for i in (0, 1)]
        return np.asarray(steps[1].astype(np.int64) * self.regions[0] + steps[0].astype(np.int64))

    def at(self, coc_px: Float[np.ndarray, "*batch"], field_xy: Float[np.ndarray, "*batch 2"]) -> Int64[np.ndarray, "*batch"]:
        """Return the knot of a signed diameter at a position."""
        middles = np.sqrt(np.array(self.diameters_px[:-1]) * np.array(self.diameters_px[1:]))
        step = np.searchsorted(middles, np.abs(coc_px))
        return np.asarray(((np.asarray(coc_px) > 0) * len(self.diameters_px) + step) * self.fields + self.fields_at(field_xy))

    def turns(self, field_xy: Float[np.ndarray, "points 2"]) -> Float64[np.ndarray, "points 2"]:
        """Return cosine and sine of the angle by which kernels are turned at each position: none unless the lens is symmetric."""
        angles = np.arctan2(field_xy[:, 1], field_xy[:, 0]) * bool(self.rings)
        return np.stack([np.cos(angles), np.sin(angles)], axis=1)

    def neighbours(self) -> dict[str, Int64[np.ndarray, "pairs 2"]]:
        """Return pairs of knots that differ by one step of "diameter" or "field", or by "side" alone."""
        numbers = np.arange(len(self)).reshape(self.shape)
        across = numbers.reshape(*self.shape[:2], 1, -1) if self.rings else numbers.reshape(*self.shape[:2], *self.regions[::-1])
        field = [_pairs(across, axis) for axis in (2, 3)]
        return {"side": _pairs(numbers, 0), "diameter": _pairs(numbers, 1), "field": np.concatenate(field)}


def _pairs(numbers: Int64[np.ndarray, "..."], axis: int) -> Int64[np.ndarray, "pairs 2"]:
    ordered = np.moveaxis(numbers, axis, 0)
    return np.stack([ordered[:-1].ravel(), ordered[1:].ravel()], axis=1)


_HUBER = 1.345
_LEAST_DEVIATION = 1e-3  # no slice is known better than this, over the root of its radiance
DARK = 0.02
"""The variance of a pixel is taken in proportion to its radiance plus this: photons, and what a sensor adds."""

Rows = Float32[np.ndarray, "rows channels cells"]
Pictures = Float[np.ndarray, "knots channels cells"]


@dataclass(frozen=True)
class Equations:
    """Equations of the pixels of one slice or light: target = rows @ picture of the pupil, for each colour.

    Both without the pixel's mean over the pupil: pictures sum to 1, so nothing is lost, and the brightness of a place, which says
    nothing about the shape of the blur, does not drown what does. weights: inverse variance, but for a factor that the slice has in
    common. knots: to which each pixel belongs.
    """

    rows: Rows
    targets: Float64[np.ndarray, "rows channels"]
    weights: Float64[np.ndarray, "rows channels"]
    knots: Int64[np.ndarray, " rows"]

    def residuals(self, pictures: Pictures) -> Float64[np.ndarray, "rows channels"]:
        """Return target minus prediction."""
        out = self.targets.copy()
        for knot in np.unique(self.knots):
            mine = self.knots == knot
            out[mine] -= np.einsum("rcp,cp->rc", self.rows[mine], pictures[knot].astype(np.float32), optimize=True)
        return out

    def error(self, pictures: Pictures) -> float:
        """Return the root mean square of the residuals over the square root of radiance (as noise is)."""
        return float(np.sqrt((self.residuals(pictures) ** 2 * self.weights).mean()))

    def robust(self, pictures: Pictures) -> Float64[np.ndarray, "rows channels"]:
        """Return weights that are 1 over the variance found, less (Huber 1964) for pixels that disagree."""
        size = np.abs(self.residuals(pictures)) * np.sqrt(self.weights)
        deviation = max(1.4826 * float(np.median(size)), _LEAST_DEVIATION)
        share = np.minimum(1.0, _HUBER * deviation / np.maximum(size, 1e-12))
        return np.asarray(self.weights * share / deviation**2)


@dataclass
class Evidence:
    """Normal equations of all knots.

    matrices (K, C, cells, cells) A'WA, sides (K, C, cells) A'Wy, energies (K,) y'Wy, counts (K,): pixels of each knot.
    """

    matrices: Float32[np.ndarray, "knots channels cells cells"]
    sides: Float64[np.ndarray, "knots channels cells"]
    energies: Float64[np.ndarray, " knots"]
    counts: Int64[np.ndarray, " knots"]

    @classmethod
    def none(cls, knots: int, channels: int, cells: int) -> "Evidence":
        return cls(
            np.zeros((knots, channels, cells, cells), np.float32),
            np.zeros((knots, channels, cells)),
            np.zeros(knots),
            np.zeros(knots, np.int64),
        )

    def add(self, equations: Equations, weights: Float64[np.ndarray, "rows channels"]) -> None:
        for knot in np.unique(equations.knots):
            mine = equations.knots == knot
            self.counts[knot] += int(mine.sum())
            self.energies[knot] += float((weights[mine] * equations.targets[mine] ** 2).sum())
            for channel in range(equations.targets.shape[1]):
                rows = equations.rows[mine, channel]
                weighted = rows * np.sqrt(weights[mine, channel], dtype=np.float32)[:, None]
                self.matrices[knot, channel] += weighted.T @ weighted
                self.sides[knot, channel] += rows.T @ (weights[mine, channel] * equations.targets[mine, channel])

    def errors(self, pictures: Pictures) -> Float64[np.ndarray, " knots"]:
        """Return the RMS residual of each knot's pixels in typical deviations of their slice; nan if there are none."""
        explained = np.matmul(self.matrices, pictures[..., None].astype(np.float32))[..., 0] - 2.0 * self.sides
        left = self.energies + (explained * pictures).sum(axis=(1, 2))
        of = np.where(self.counts > 0, self.counts * self.sides.shape[1], np.nan)
        return np.asarray(np.sqrt(np.maximum(left, 0.0) / of))


@dataclass(frozen=True)
class Sharing:
    """Choice of which pictures are one and the same."""

    colours: bool = False
    diameters: bool = False
    sides: bool = False

    def merged(self, evidence: Evidence, knots: Knots) -> tuple[Evidence, Knots]:
        """Return the evidence of those that share, and the knots that are left; sides stay two, each with the evidence of both."""
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
        """Return the pictures of all knots and colours, from those of `merged`."""
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
    """Return the first description, given from the simplest on, that is no worse than the best. errors: of each, slice by slice."""
    squares = np.square(np.asarray(errors, np.float64))
    if squares.size == 0:
        return len(squares) - 1
    worse = squares - squares[squares.sum(axis=1).argmin()]
    deviation = worse.std(axis=1, ddof=1) if squares.shape[1] > 1 else np.zeros(len(squares))
    return int(np.argmax(worse.mean(axis=1) <= deviation / np.sqrt(squares.shape[1])))
