"""The kernels of a bank as apertures, so that renderers which spread by polygons can spread by a bank."""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product

import numpy as np
from jaxtyping import Float, Float64, Int64

from mrbokeh.optics.aperture import Aperture
from mrbokeh.renderers.bank.lattice import SIDES, BankLattice, between
from mrbokeh.renderers.kernels.polygon_fit import LEVELS, PolygonFit, fit_polygons, grown, relative_error
from mrbokeh.system.console import track
from mrbokeh.system.errors import InputError

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
        """How far the farthest vertex of any lies from the centre of the pupil."""
        return max(each.unit_radius for side in self.apertures for node in side for place in node for each in place)

    def is_one(self, side: int, channel: int) -> bool:
        """Whether a single aperture stands for all kernels on a side of the focus."""
        of_side = self.apertures[SIDES.index(side)]
        return len({id(place[channel]) for node in of_side for place in node}) == 1

    def shares(
        self, side: int, diameters_px: Float[np.ndarray, "*batch"]
    ) -> tuple[Int64[np.ndarray, "*batch"], Float64[np.ndarray, "*batch"]]:
        """The fitted diameter below each unsigned diameter and the share of the next one: in proportion to the logarithm."""
        return between(np.log(self.diameters_px[SIDES.index(side)]), np.asarray(np.log(np.maximum(diameters_px, 1e-6))))

    def kernel(self, side: int, diameter_px: float, place: int, channel: int) -> Float64[np.ndarray, "size size"]:
        """What they show at an unsigned diameter, as behind the focus."""
        lower, share = (each.item() for each in self.shares(side, np.array(diameter_px)))
        fitted = [each[place][channel] for each in self.apertures[SIDES.index(side)]]
        parts = ((fitted[lower], 1.0 - share), (fitted[min(lower + 1, len(fitted) - 1)], share))
        drawn = [(aperture.rasterize(diameter_px).kernel, weight) for aperture, weight in parts if weight > 0.0]
        size = max(len(kernel) for kernel, _ in drawn)
        return np.sum([weight * grown(kernel, size) for kernel, weight in drawn], axis=0)

    def relative_errors(self, lattice: BankLattice, side: int) -> Float64[np.ndarray, "nodes places channels"]:
        """What they miss of every kernel of a bank on one side of the focus, norm over norm, blended where they are."""
        diameters_px = lattice.diameters_px[side]
        errors = np.zeros((len(diameters_px), lattice.places, lattice.bank.channels))
        for node, place in np.ndindex(*errors.shape[:2]):
            wanted = lattice.kernel(side, node, place)
            for channel in range(lattice.bank.channels):
                found = self.kernel(side, float(diameters_px[node]), place, channel)
                errors[node, place, channel] = relative_error(found, wanted[..., channel])
        return errors


def fit_apertures(lattice: BankLattice, levels: int = LEVELS) -> BankApertures:
    """Polygons for the kernels of a bank at a few diameters on each side; one of kernels below 8 px only is an InputError.

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
        found[key] = _fit(wanted, diameter_px, near, levels)

    def of_side(side: int) -> list[list[list[PolygonFit]]]:
        steps = range(len(nodes[side]))
        return [[[found[side, step, place, channel] for channel in range(shape[1])] for place in range(shape[0])] for step in steps]

    fits = [of_side(side) for side in SIDES]
    diameters_px = tuple(tuple(lattice.diameters_px[side][nodes[side]].tolist()) for side in SIDES)
    apertures = tuple(tuple(tuple(tuple(fit.aperture for fit in each) for each in node) for node in side) for side in fits)
    errors = tuple(np.array([[[fit.relative_error for fit in each] for each in node] for node in side]) for side in fits)
    return BankApertures(diameters_px, apertures, errors)


def _neighbours(key: _Key) -> list[_Key]:
    """Those whose aperture may serve: at the next larger diameter, on the other side of the focus, one place or one colour before."""
    side, step, place, channel = key
    first = [(SIDES[0], step, place, channel)] if side != SIDES[0] else []
    return [(side, step + 1, place, channel), *first, (side, step, place - 1, channel), (side, step, place, channel - 1)]


def _fit(wanted: Float64[np.ndarray, "size size"], diameter_px: float, near: Sequence[Aperture], levels: int) -> PolygonFit:
    """The first of the apertures near by that is hardly worse than a kernel's own, else that."""
    own = fit_polygons(wanted, diameter_px, levels)
    for aperture in near:
        error = relative_error(aperture.rasterize(diameter_px).kernel, wanted)
        if error <= _ALIKE * own.relative_error:
            return PolygonFit(aperture, error)
    return own


def _fitted_nodes(diameters_px: Float64[np.ndarray, " nodes"]) -> list[int]:
    """From the largest diameter downwards."""
    if diameters_px[-1] < LEAST_FITTED_PX:
        raise InputError(
            f"polygons need kernels of at least {LEAST_FITTED_PX:g} px, but this bank ends at {diameters_px[-1]:.1f} px: "
            "take --method laplacian, or a bank of more blur"
        )
    count = 1 + int(np.log(diameters_px[-1] / LEAST_FITTED_PX) / np.log(_STEP))
    wanted = diameters_px[-1] / _STEP ** np.arange(count)
    nearest = {int(np.argmin(np.abs(diameters_px - each))) for each in wanted}
    return sorted(node for node in nearest if diameters_px[node] >= min(LEAST_FITTED_PX, diameters_px[-1]))
