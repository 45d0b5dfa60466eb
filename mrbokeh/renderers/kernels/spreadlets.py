"""Spreadlets: a PSF as few points whose sum, integrated, is nearly the PSF (Leimkuehler et al. 2018, Section 5.5).

The 3x3 Laplacian of a kernel is gathered into points: darts thrown by importance, Lloyd's relaxation, sums over Voronoi
cells, annealing with merging. What the paper stores are the sums; they keep the charge and nothing else, so the light would
drift and shine far beyond its circle. Here the values are fitted in a last step (mrbokeh.renderers.kernels.spreadlet_values): the light and
the centroid are exact, and the error is the least for these points. Without `fit` the sums stay as in the paper.

Where the paper is silent: the radius around a dart is that of a disc which holds the charge of a point, sum |L| / points;
the number of points is `points_per_px` times the length of the kernel's outline, sum |grad f| / sum f^2, which is the
circumference for a disc; the cost is the squared error instead of the absolute one, which makes one step a matter of
points squared; the temperature begins at 1 % of the cost and falls linearly.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Float64, Int16, Int64

from mrbokeh.renderers.kernels.laplacian_integration import laplacian
from mrbokeh.renderers.kernels.spreadlet_values import fitted_values, potential_of, table_for
from mrbokeh.system.errors import InputError

_LEAST_CHARGE = 1e-9
_DART_RADIUS = 1.75  # of the radius of a disc with the charge of one point: darts that keep that far apart come out about as many as wanted
_MOVED_SHARE, _HEAT = 0.01, 0.01


@dataclass(frozen=True)
class Sparsification:
    """How a kernel becomes few points.

    points_per_px: points per pixel of outline, and at least `least_points`: a bright core in a wide veil has a short outline,
    and fewer than 30 points cannot hold all moments. failures, lloyd_steps, annealing_steps: as in the paper. fit: least squares at
    the end instead of sums over cells. seed: of darts and annealing; the same seed gives the same points.
    """

    points_per_px: float = 1.0
    least_points: int = 48
    failures: int = 10_000
    lloyd_steps: int = 50
    annealing_steps: int = 400
    fit: bool = True
    seed: int = 0

    def __post_init__(self) -> None:
        if not self.points_per_px > 0.0 or self.least_points < 1 or min(self.failures, self.lloyd_steps, self.annealing_steps) < 0:
            raise InputError(f"a sparsification needs a positive number of points and no negative steps, got {self}")


UNRELAXED = Sparsification(lloyd_steps=0, annealing_steps=0)
"""Darts and fitted values alone: a hundredth of the time, a tenth of the error more."""


@dataclass(frozen=True)
class Spreadlet:
    """Points (N, 2) x right, y down in whole pixels from the source pixel, and values (N, C), C 1 or 3."""

    points: Int16[np.ndarray, "points 2"]
    values: Float64[np.ndarray, "points channels"]


@dataclass(frozen=True)
class Spreadlets:
    """Spreadlets of many kernels one after the other; that of cell i is [starts[i]:starts[i + 1]].

    Values are kept in double precision: rounded to single, their sum would not be 0, and what every pixel of a picture
    leaves over adds up.
    """

    points: Int16[np.ndarray, "points 2"]
    values: Float64[np.ndarray, "points channels"]
    starts: Int64[np.ndarray, " starts"]

    @classmethod
    def joined(cls, spreadlets: Sequence[Spreadlet]) -> "Spreadlets":
        starts = np.cumsum([0, *(len(each.points) for each in spreadlets)]).astype(np.int64)
        return cls(np.concatenate([each.points for each in spreadlets]), np.concatenate([each.values for each in spreadlets]), starts)

    def __len__(self) -> int:
        return len(self.starts) - 1

    def __getitem__(self, cell: int) -> Spreadlet:
        part = slice(int(self.starts[cell]), int(self.starts[cell + 1]))
        return Spreadlet(self.points[part], self.values[part])


def whole_laplacian(kernel: Float[np.ndarray, "height width *channels"]) -> Spreadlet:
    """Every pixel of a kernel's Laplacian that is not 0: the exact spreadlet, the twin of `sparsify`."""
    xy, charges, _ = _charges(kernel)
    return Spreadlet(xy.astype(np.int16), charges)


def sparsify(kernel: Float[np.ndarray, "height width *channels"], settings: Sparsification | None = None) -> Spreadlet:
    """A kernel (K, K) or (K, K, C), K odd, as few points. A kernel that has few pixels anyway comes back whole."""
    from mrbokeh.renderers.kernels._spreadlets_numba import anneal, cell_sums, cost, relax, throw_darts

    settings = settings or Sparsification()
    xy, charges, dense = _charges(kernel)
    importance = np.abs(charges).sum(axis=1)
    wanted = max(settings.points_per_px * outline_px(kernel), settings.least_points)
    if len(xy) <= wanted:
        return Spreadlet(xy.astype(np.int16), charges)
    radius_px = np.sqrt(importance.sum() / wanted / (np.pi * importance)) * _DART_RADIUS
    points = xy[throw_darts(xy, importance, radius_px, settings.failures, settings.seed)].astype(np.float64)
    relax(points, xy, importance, settings.lloyd_steps)
    places = np.unique(np.rint(points).astype(np.int64), axis=0)
    table = table_for(len(dense))
    potential = potential_of(dense, table)
    middle = len(dense) // 2
    if settings.annealing_steps:
        error = cost(places, cell_sums(places, xy, charges), potential, table, middle) + _self_cost(xy, charges, potential)
        chance = settings.annealing_steps, _MOVED_SHARE, _HEAT * abs(error), settings.seed + 1
        places = anneal(places, xy, charges, potential, table, middle, *chance)
    values = fitted_values(places, xy, charges, potential, table) if settings.fit else cell_sums(places, xy, charges)
    return Spreadlet(places.astype(np.int16), values)


def outline_px(kernel: Float[np.ndarray, "height width *channels"]) -> float:
    """Length of a kernel's outline: its total variation over its sum of squares; the circumference of a disc."""
    values = np.pad(kernel.reshape(*kernel.shape[:2], -1).astype(np.float64), ((1, 1), (1, 1), (0, 0)))
    down, right = np.diff(values, axis=0)[:, :-1], np.diff(values, axis=1)[:-1]
    return float(np.sqrt(down**2 + right**2).sum() / (values**2).sum())


def _charges(kernel: np.ndarray) -> tuple[Int64[np.ndarray, "pixels 2"], Float64[np.ndarray, "pixels channels"], np.ndarray]:
    """Places and values of what is not 0 of the Laplacian, and all of it."""
    if kernel.ndim not in (2, 3) or kernel.shape[0] != kernel.shape[1] or kernel.shape[0] % 2 == 0:
        raise InputError(f"a kernel must be square with an odd size, (K, K) or (K, K, C), but came with shape {kernel.shape}")
    dense = laplacian(kernel.reshape(*kernel.shape[:2], -1))
    magnitude = np.abs(dense).sum(axis=2)
    rows, columns = np.nonzero(magnitude > _LEAST_CHARGE * magnitude.max())
    middle = len(dense) // 2
    return np.stack([columns - middle, rows - middle], axis=1).astype(np.int64), dense[rows, columns], dense


def _self_cost(xy: np.ndarray, charges: np.ndarray, potential: np.ndarray) -> float:
    middle = potential.shape[0] // 2
    return float((charges * potential[xy[:, 1] + middle, xy[:, 0] + middle]).sum())
