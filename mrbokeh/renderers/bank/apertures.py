"""Kernels of a bank as apertures, so that renderers which sum polygons can use a bank: fitting, and turning to where they are used.

A measured kernel becomes weighted polygons: its iso-contours in the unit pupil, weighted so that they add up to it.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from itertools import pairwise, product
from threading import Lock
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float, Float64, Int64

from mrbokeh.layering.psf_over_field import Plane
from mrbokeh.optics.aperture import Aperture
from mrbokeh.optics.aperture_shapes import WeightedOutlines, net_area, outlines_of
from mrbokeh.renderers.bank.blending import SHARP_PX, Shares
from mrbokeh.renderers.bank.lattice import SIDES, Around, BankLattice, between
from mrbokeh.system.console import track
from mrbokeh.system.errors import InputError

LEVELS = 4
_SPECK_PX2 = 0.5
_ISLANDS = (0.02, 0.05)  # of the area of the circle of confusion: smaller ones may be left out
_STRAY_PX = 0.05
_SUM_TO_ONE = 10.0
_LEAST_WEIGHT = 0.005
_FEWER_LEVELS, _NO_ISLANDS = 1.1, 4.0 / 3.0


class PolygonFit(NamedTuple):
    """Aperture that stands for a kernel, as seen behind the focus. relative_error: what it misses of the kernel, norm over norm."""

    aperture: Aperture
    relative_error: float


def fit_polygons(kernel: Float[np.ndarray, "size size"], diameter_px: float, levels: int = LEVELS) -> PolygonFit:
    """Return a kernel of a point behind the focus with this circle of confusion (above 0) as a sum of polygons.

    The candidates are the kernel's contours at `levels` heights; their weights are those, none negative, that come nearest to it
    in the sense of squares when drawn at this diameter, and give its sum. Renderers pay for every outline, so half as many levels are
    taken where they miss at most 10 % more, and small islands, which are the noise of a measurement, are left out where that misses
    at most a third more. Raises InputError if the kernel has no inside.
    """
    if not diameter_px > 2.0 or levels < 1:
        raise InputError(f"polygons are fitted to kernels of more than 2 px in 1 or more levels, got {diameter_px} px and {levels}")
    wanted = kernel.astype(np.float64) / kernel.sum(dtype=np.float64)
    fits = {count: fit for count in _counts(levels) if (fit := _fit(wanted, diameter_px, count, _SPECK_PX2)) is not None}
    if not fits:
        raise InputError(f"this kernel of {len(kernel)} px has no inside to draw polygons around: take --renderer laplacian, or more blur")
    best = min(fit.relative_error for fit in fits.values())
    count = next(each for each, fit in fits.items() if fit.relative_error <= _FEWER_LEVELS * best)
    cleaned = [_fit(wanted, diameter_px, count, share * 0.25 * np.pi * diameter_px**2) for share in _ISLANDS]
    good = [fit for fit in cleaned if fit is not None and fit.relative_error <= _NO_ISLANDS * best]
    return min([fits[count], *good], key=lambda fit: len(fit.aperture.outlines))


def _counts(levels: int) -> list[int]:
    """Return the numbers of levels to try: `levels` and halves of it, ascending."""
    return sorted({max(1, levels >> i) for i in range(levels.bit_length())})


def _fit(wanted: Float64[np.ndarray, "size size"], diameter_px: float, levels: int, least_px2: float) -> PolygonFit | None:
    """Fit contours around areas larger than this; None if there are none."""
    heights = (np.arange(levels) + 0.5) / levels
    candidates = [each for height in heights if (each := _contour(wanted, float(height), 0.5 * diameter_px, least_px2)) is not None]
    if not candidates:
        return None
    weights = _weights([_drawn(each, diameter_px) for each in candidates], wanted)
    kept = [(each, weight) for each, weight in zip(candidates, weights, strict=True) if weight > _LEAST_WEIGHT]
    outlines = tuple(outline for each, _ in kept for outline in each[0])
    aperture = Aperture(outlines, tuple(weight * share / net_area(each) for each, weight in kept for share in each[1]))
    return PolygonFit(aperture, relative_error(aperture.rasterize(diameter_px).kernel, wanted))


def relative_error(found: Float[np.ndarray, "rows rows"], wanted: Float[np.ndarray, "size size"]) -> float:
    """Return the norm of the difference of two centred kernels over that of the one wanted."""
    size = max(len(found), len(wanted))
    return float(np.linalg.norm(grown(found, size) - grown(wanted, size)) / np.linalg.norm(wanted))


def grown(kernel: Float64[np.ndarray, "rows rows"], size: int) -> Float64[np.ndarray, "size size"]:
    """Return a kernel with a border of zeros, so that it is `size` wide; both odd."""
    return np.pad(kernel, (size - len(kernel)) // 2)


def _contour(kernel: Float64[np.ndarray, "size size"], height: float, radius_px: float, least_px2: float) -> WeightedOutlines | None:
    """Return the area where a kernel is brighter than this share of its brightest pixel, in the unit pupil; None if that is nothing."""
    from contourpy import FillType, contour_generator
    from shapely import MultiPolygon, Polygon, make_valid

    padded = np.pad(kernel / kernel.max(), 1)
    middle = 0.5 * (len(padded) - 1)
    tracer: Any = contour_generator(z=padded, fill_type=FillType.OuterOffset)
    areas = []
    for points, starts in zip(*tracer.filled(height, 2.0), strict=True):
        rings = [points[start:stop] - middle for start, stop in pairwise(starts)]
        areas.append(Polygon(rings[0], rings[1:]))
    large = [part for part in areas if part.area > least_px2]
    found = outlines_of(make_valid(MultiPolygon(large)).simplify(_STRAY_PX))
    return (tuple(outline / radius_px for outline in found[0]), found[1]) if found[0] else None


def _drawn(opening: WeightedOutlines, diameter_px: float) -> Float64[np.ndarray, "size size"]:
    return Aperture(*opening).rasterize(diameter_px).kernel


def _weights(drawn: Sequence[np.ndarray], wanted: Float64[np.ndarray, "size size"]) -> Float64[np.ndarray, " candidates"]:
    """Return weights, sum 1, of candidates that sum to 1 each."""
    from scipy.optimize import nnls

    size = max(len(each) for each in (*drawn, wanted))
    columns = np.stack([grown(each, size).ravel() for each in drawn], axis=1)
    firmly = _SUM_TO_ONE * np.linalg.norm(wanted)
    found, _ = nnls(np.vstack([columns, np.full((1, len(drawn)), firmly)]), np.append(grown(wanted, size).ravel(), firmly))
    return np.asarray(found / found.sum())


LEAST_FITTED_PX = 8.0
"""Smaller kernels say too little about their shape: they take that of the smallest one from here on."""
_ALIKE = 1.2  # a neighbour's aperture may miss so much more of a kernel than its own does
_STEP = 1.5  # diameters whose kernels are fitted lie so far apart, in proportion

_Key = tuple[int, int, int, int]  # side, number of the fitted diameter, place, channel


@dataclass(frozen=True, eq=False)
class BankApertures:
    """Apertures fitted to kernels of a bank, as points behind the focus show them; for diameters between they are blended.

    diameters_px: of each side (behind, in front), ascending, where kernels were fitted. apertures: [side][diameter][place][channel];
    kernels that are alike have one and the same object, which renderers spread once.
    fit_errors (diameters, places, channels), of each side: what each aperture misses of its kernel, norm over norm.
    """

    diameters_px: tuple[tuple[float, ...], ...]
    apertures: tuple[tuple[tuple[tuple[Aperture, ...], ...], ...], ...]
    fit_errors: tuple[Float64[np.ndarray, "_ places channels"], ...]

    @property
    def unit_radius(self) -> float:
        """Distance of the farthest vertex of any aperture from the centre of the pupil."""
        return max(each.unit_radius for side in self.apertures for node in side for place in node for each in place)

    def is_one(self, side: int, channel: int) -> bool:
        """Return whether a single aperture stands for all kernels on a side of the focus."""
        of_side = self.apertures[SIDES.index(side)]
        return len({id(place[channel]) for node in of_side for place in node}) == 1

    def shares(
        self, side: int, diameters_px: Float[np.ndarray, "*batch"]
    ) -> tuple[Int64[np.ndarray, "*batch"], Float64[np.ndarray, "*batch"]]:
        """Return the fitted diameter below each unsigned diameter and the share of the next one: in proportion to the logarithm."""
        return between(np.log(self.diameters_px[SIDES.index(side)]), np.asarray(np.log(np.maximum(diameters_px, 1e-6))))

    def kernel(self, side: int, diameter_px: float, place: int, channel: int) -> Float64[np.ndarray, "size size"]:
        """Draw the kernel that the apertures give at an unsigned diameter, as behind the focus."""
        lower, share = (each.item() for each in self.shares(side, np.array(diameter_px)))
        fitted = [each[place][channel] for each in self.apertures[SIDES.index(side)]]
        parts = ((fitted[lower], 1.0 - share), (fitted[min(lower + 1, len(fitted) - 1)], share))
        drawn = [(aperture.rasterize(diameter_px).kernel, weight) for aperture, weight in parts if weight > 0.0]
        size = max(len(kernel) for kernel, _ in drawn)
        return np.sum([weight * grown(kernel, size) for kernel, weight in drawn], axis=0)

    def relative_errors(self, lattice: BankLattice, side: int) -> Float64[np.ndarray, "nodes places channels"]:
        """Return what the apertures miss of every kernel of a bank on one side of the focus, norm over norm, blended as in use."""
        diameters_px = lattice.diameters_px[side]
        errors = np.zeros((len(diameters_px), lattice.places, lattice.bank.channels))
        for node, place in np.ndindex(*errors.shape[:2]):
            wanted = lattice.kernel(side, node, place)
            for channel in range(lattice.bank.channels):
                found = self.kernel(side, float(diameters_px[node]), place, channel)
                errors[node, place, channel] = relative_error(found, wanted[..., channel])
        return errors


def fit_apertures(lattice: BankLattice, levels: int = LEVELS) -> BankApertures:
    """Fit polygons to the kernels of a bank at a few diameters on each side; a bank of kernels below 8 px only is an InputError.

    A kernel takes the aperture of a neighbour (see `_neighbours`) that misses at most a fifth more of it than its own polygons do.
    """
    nodes = {side: _fitted_nodes(lattice.diameters_px[side]) for side in SIDES}
    shape = lattice.places, lattice.bank.channels
    columns = list(product(range(shape[0]), range(shape[1])))
    keys = [(side, step, *each) for side in SIDES for step in reversed(range(len(nodes[side]))) for each in columns]
    found: dict[_Key, PolygonFit] = {}
    for key in track(keys, "polygons of the bank"):
        side, step, place, channel = key
        node = nodes[side][step]
        wanted, diameter_px = lattice.kernel(side, node, place)[..., channel], float(lattice.diameters_px[side][node])
        near = [found[each].aperture for each in _neighbours(key) if each in found]
        found[key] = _best_fit(wanted, diameter_px, near, levels)

    def of_side(side: int) -> list[list[list[PolygonFit]]]:
        steps = range(len(nodes[side]))
        return [[[found[side, step, place, channel] for channel in range(shape[1])] for place in range(shape[0])] for step in steps]

    fits = [of_side(side) for side in SIDES]
    diameters_px = tuple(tuple(lattice.diameters_px[side][nodes[side]].tolist()) for side in SIDES)
    apertures = tuple(tuple(tuple(tuple(fit.aperture for fit in each) for each in node) for node in side) for side in fits)
    errors = tuple(np.array([[[fit.relative_error for fit in each] for each in node] for node in side]) for side in fits)
    return BankApertures(diameters_px, apertures, errors)


def _neighbours(key: _Key) -> list[_Key]:
    """Return the keys whose aperture may serve: at the next larger diameter, on the other side of the focus, one place or one colour
    before.
    """
    side, step, place, channel = key
    first = [(SIDES[0], step, place, channel)] if side != SIDES[0] else []
    return [(side, step + 1, place, channel), *first, (side, step, place - 1, channel), (side, step, place, channel - 1)]


def _best_fit(wanted: Float64[np.ndarray, "size size"], diameter_px: float, near: Sequence[Aperture], levels: int) -> PolygonFit:
    """Return the first of the apertures near by that is hardly worse than the kernel's own, else its own."""
    own = fit_polygons(wanted, diameter_px, levels)
    for aperture in near:
        error = relative_error(aperture.rasterize(diameter_px).kernel, wanted)
        if error <= _ALIKE * own.relative_error:
            return PolygonFit(aperture, error)
    return own


def _fitted_nodes(diameters_px: Float64[np.ndarray, " nodes"]) -> list[int]:
    """Return the nodes to fit, ascending; they are chosen from the largest diameter downwards."""
    if diameters_px[-1] < LEAST_FITTED_PX:
        raise InputError(
            f"polygons need kernels of at least {LEAST_FITTED_PX:g} px, but this bank ends at {diameters_px[-1]:.1f} px: "
            "take --renderer laplacian, or a bank of more blur"
        )
    count = 1 + int(np.log(diameters_px[-1] / LEAST_FITTED_PX) / np.log(_STEP))
    wanted = diameters_px[-1] / _STEP ** np.arange(count)
    nearest = {int(np.argmin(np.abs(diameters_px - each))) for each in wanted}
    return sorted(node for node in nearest if diameters_px[node] >= min(LEAST_FITTED_PX, diameters_px[-1]))


@dataclass(frozen=True, eq=False)
class TurnedApertures:
    """The apertures of a bank turned to where they are used, kept: renderers keep tables for each as long as it lives.

    prepare: makes those tables, once for each although slices are spread at the same time.
    """

    lattice: BankLattice
    apertures: BankApertures
    prepare: Callable[[Aperture], object]
    _kept: dict[tuple[int, float], Aperture] = field(default_factory=dict, repr=False)
    _preparing: Lock = field(default_factory=Lock, repr=False)

    def shares(self, coc_px: Plane, side: int, channel: int, around: Around) -> Shares:
        """Yield a share for each opening that some pixel takes; places and diameters that share an aperture are one."""
        if self.apertures.is_one(side, channel) and self.lattice.directions == 1:
            yield None, self._aperture(side, 0, 0, channel)
            return
        taken: dict[int, tuple[Plane, Aperture]] = {}
        of_nodes = list(self._by_node(coc_px, side))
        for anchor, share in around.by_anchor():
            for node, of_node in of_nodes:
                mine = of_node if share is None else share * of_node
                if (mine > 0).any():
                    opening = self._aperture(side, node, anchor, channel)
                    before = taken.get(id(opening))
                    taken[id(opening)] = (mine if before is None else before[0] + mine, opening)
        yield from taken.values()

    def _by_node(self, coc_px: Plane, side: int) -> Iterator[tuple[int, Plane]]:
        """Yield the fitted diameters in use, and each pixel's share of them; sharp pixels have none."""
        lower, upper = self.apertures.shares(side, np.abs(coc_px))
        live = np.abs(coc_px) > SHARP_PX
        for node in range(len(self.apertures.diameters_px[SIDES.index(side)])):
            of_node = live * np.where(lower == node, 1.0 - upper, np.where(lower + 1 == node, upper, 0.0)).astype(np.float32)
            if of_node.any():
                yield node, of_node

    def _aperture(self, side: int, node: int, anchor: int, channel: int) -> Aperture:
        place, angle_rad = self.lattice.place_and_angle(anchor)
        upright = self.apertures.apertures[SIDES.index(side)][node][place][channel]
        key = id(upright), angle_rad
        with self._preparing:
            if key not in self._kept:
                aperture = upright.rotated(angle_rad)
                self.prepare(aperture)
                self._kept[key] = aperture
            return self._kept[key]
