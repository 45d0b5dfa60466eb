"""Spreadlets: a PSF as few points whose sum, integrated, is nearly the PSF (Leimkuehler et al. 2018, Section 5.5).

The 3x3 Laplacian of a kernel is gathered into points: darts thrown by importance, Lloyd's relaxation, sums over Voronoi
cells, annealing with merging. What the paper stores are the sums; they keep the charge and nothing else, so the light would
drift and shine far beyond its circle. Here the values are fitted in a last step: the light and the centroid are exact, and the error
is the least for these points. Without `fit` the sums stay as in the paper.

Where the paper is silent: the radius around a dart is that of a disc which holds the charge of a point, sum |L| / points;
the number of points is `points_per_px` times the length of the kernel's outline, sum |grad f| / sum f^2, which is the
circumference for a disc; the cost is the squared error instead of the absolute one, which makes one step a matter of
points squared; the temperature begins at 1 % of the cost and falls linearly.

The fit is a least-squares one over the whole plane. A kernel f with Laplacian L = D f is replaced by the sum of v_j at points p_j;
what is seen is G v, with G the inverse of D. The squared error is |G (L - v)|^2 = (L - v) K (L - v), K = G G: the Green's function of
the squared Laplacian, r^2 log r / (8 pi) far away. K grows, so the error is finite only if L - v has neither charge nor dipole:
thin-plate splines in other clothes.

What the moments of L mean, by Green's second identity, sum(L p) = sum(f D p) for every polynomial p:
- D 1 = D x = D y = 0: charge and dipole of L are 0, else a spreadlet would shine to infinity as log r or 1 / r;
- D (x^2 + y^2) = 4: sum of L (x^2 + y^2) / 4 is the light of f, 1 for a PSF;
- D (x (x^2 + y^2)) = 8 x: it gives the centroid of the light, and y likewise;
- x^2 - y^2, x y, x^3 - 3 x y^2, 3 x^2 y - y^3 are harmonic: 0 for L, else light far outside the kernel falls as 1 / r^2, 1 / r^3.
The 3x3 stencil has these Laplacians exactly. So all ten moments up to degree 3 of v are set equal to those of L: light and
centroid are exact, and what shines outside falls as 1 / r^4.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from jaxtyping import Float, Float64, Int16, Int64

from mrbokeh.renderers.kernels.laplacian_integration import fast_width, integrate, laplacian
from mrbokeh.system.errors import InputError

_DOMAIN = 4  # the table's domain over its reach: what the border adds to K is smooth, and polynomials up to degree 7 cancel
_POINTS_PER_MOMENT = 3
_LEAST_MOMENT = 1e-9
_LEAST_CHARGE = 1e-9
_DART_RADIUS = 1.75  # of the radius of a disc with the charge of one point: darts that keep that far apart come out about as many as wanted
_MOVED_SHARE, _HEAT = 0.01, 0.01


@dataclass(frozen=True)
class Sparsification:
    """Settings of how a kernel becomes few points.

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
    """Return every pixel of a kernel's Laplacian that is not 0: the exact spreadlet, the twin of `sparsify`."""
    xy, charges, _ = _charges(kernel)
    return Spreadlet(xy.astype(np.int16), charges)


def sparsify(kernel: Float[np.ndarray, "height width *channels"], settings: Sparsification | None = None) -> Spreadlet:
    """Return a kernel (K, K) or (K, K, C), K odd, as few points. A kernel that has few pixels anyway comes back whole."""
    from mrbokeh.renderers.kernels._laplacian_numba import anneal, cell_sums, cost, relax, throw_darts

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
    """Return the length of a kernel's outline: its total variation over its sum of squares; the circumference of a disc."""
    values = np.pad(kernel.reshape(*kernel.shape[:2], -1).astype(np.float64), ((1, 1), (1, 1), (0, 0)))
    down, right = np.diff(values, axis=0)[:, :-1], np.diff(values, axis=1)[:-1]
    return float(np.sqrt(down**2 + right**2).sum() / (values**2).sum())


def _charges(kernel: np.ndarray) -> tuple[Int64[np.ndarray, "pixels 2"], Float64[np.ndarray, "pixels channels"], np.ndarray]:
    """Return places and values of the Laplacian's pixels that are not 0, and all of it."""
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


@lru_cache(maxsize=8)
def biharmonic_table(reach_px: int) -> Float64[np.ndarray, "side side"]:
    """Return K by whole distances [|y|, |x|] from 0 to reach_px, up to terms that the moments cancel."""
    half = fast_width(_DOMAIN // 2 * reach_px + 2)
    source = np.zeros((2 * half + 1, 2 * half + 1, 1))
    source[half, half] = 1.0
    twice = integrate(integrate(source))[half : half + reach_px + 1, half : half + reach_px + 1, 0]
    return np.ascontiguousarray(0.5 * (twice + twice.T))


def potential_of(charges: Float64[np.ndarray, "size size channels"], table: Float64[np.ndarray, "side side"]) -> np.ndarray:
    """Return K L on the pixels of L; the table must reach across."""
    reach = charges.shape[0] - 1
    quarter = table[: reach + 1, : reach + 1]
    half = np.concatenate([quarter[:0:-1], quarter])
    kernel = np.concatenate([half[:, :0:-1], half], axis=1)
    # Here, for this import takes a second.
    from scipy.signal import fftconvolve

    return fftconvolve(charges, kernel[..., None], mode="same", axes=(0, 1)) if reach else charges * table[0, 0]


def table_for(size: int) -> Float64[np.ndarray, "side side"]:
    """Return a table for Laplacians of this many pixels across; sizes share tables."""
    return biharmonic_table(1 << int(np.ceil(np.log2(max(size, 16)))))


def moments(xy: np.ndarray, scale_px: float | np.ndarray, degree: int) -> Float64[np.ndarray, "points moments"]:
    """Return monomials up to a degree at every point, in units of scale_px, one for both axes or one for each."""
    x, y = (xy / scale_px).T
    return np.stack([x ** (total - j) * y**j for total in range(degree + 1) for j in range(total + 1)], axis=1)


def fitted_values(
    points: Int64[np.ndarray, "points 2"],
    xy: Int64[np.ndarray, "pixels 2"],
    charges: Float64[np.ndarray, "pixels channels"],
    potential: Float64[np.ndarray, "size size channels"],
    table: Float64[np.ndarray, "side side"],
) -> Float64[np.ndarray, "points channels"]:
    """Return the values at the points with the least squared error that keep the moments of the charges."""
    radius_px = potential.shape[0] // 2
    return _solved(points, xy, charges, potential[points[:, 1] + radius_px, points[:, 0] + radius_px], table)


def turned(
    points: Int16[np.ndarray, "points 2"], values: Float64[np.ndarray, "points channels"], angle_rad: float
) -> tuple[Int16[np.ndarray, "places 2"], Float64[np.ndarray, "places channels"]]:
    """Turn a spreadlet from x towards y: points at the nearest whole pixels with values fitted to where they should be.

    Rounding alone would give every point a dipole; as the moments are fitted, light and centroid stay exact here, too.
    """
    cosine, sine = np.cos(angle_rad), np.sin(angle_rad)
    wanted = points @ np.array([[cosine, sine], [-sine, cosine]])
    places = np.unique(np.rint(wanted).astype(np.int64), axis=0)
    if abs(wanted - np.rint(wanted)).max() < 1e-9:
        order = np.lexsort((np.rint(wanted[:, 1]), np.rint(wanted[:, 0])))
        return places.astype(np.int16), values[order]
    from scipy.ndimage import map_coordinates

    table = table_for(2 * int(np.abs(wanted).max() + 2.0) + 1)
    apart = np.abs(places[:, None] - wanted)
    between = map_coordinates(_spline(len(table)), [apart[..., 1], apart[..., 0]], order=3, mode="mirror", prefilter=False)
    return places.astype(np.int16), _solved(places, wanted, values, between @ values, table)


@lru_cache(maxsize=8)
def _spline(side: int) -> Float64[np.ndarray, "side side"]:
    """Return coefficients that make a table of this size smooth between whole distances."""
    from scipy.ndimage import spline_filter

    return spline_filter(biharmonic_table(side - 1), order=3, mode="mirror")


def _solved(
    points: Int64[np.ndarray, "points 2"],
    xy: np.ndarray,
    charges: Float64[np.ndarray, "pixels channels"],
    potential: Float64[np.ndarray, "points channels"],
    table: Float64[np.ndarray, "side side"],
) -> Float64[np.ndarray, "points channels"]:
    """Return values at points (N, 2) for charges at xy (M, 2), whose potential at the points is known.

    Moments up to degree 3 are kept with at least 30 points; fewer points keep fewer moments, at least the charge. Points in few
    rows, as those of a line, cannot have all of them on their own (y^3 = y in rows -1, 0 and 1): `_independent`.
    """
    from mrbokeh.renderers.kernels._laplacian_numba import solve

    scale_px = float(max(np.abs(xy).max(), 1.0))
    degree = max(d for d in range(4) if d == 0 or (d + 1) * (d + 2) // 2 * _POINTS_PER_MOMENT <= len(points))
    held, wanted = _independent(points, xy, charges, degree)
    apart = np.abs(points[:, None] - points)
    count, extra = len(points), held.shape[1]
    matrix = np.zeros((count + extra, count + extra))
    matrix[:count, :count] = table[apart[..., 1], apart[..., 0]] / scale_px**2
    matrix[:count, count:], matrix[count:, :count] = held, held.T
    values = np.concatenate([potential / scale_px**2, wanted])
    if not solve(matrix, values):
        raise np.linalg.LinAlgError(f"{count} points cannot hold {extra} moments")
    return values[:count]


def _independent(
    points: Int64[np.ndarray, "points 2"], xy: np.ndarray, charges: Float64[np.ndarray, "pixels channels"], degree: int
) -> tuple[Float64[np.ndarray, "points kept"], Float64[np.ndarray, "kept channels"]]:
    """Return combinations of moments that the points can have independently, and the charges' share of them.

    The degree is lowered if the charges have a moment that the points cannot have.
    """
    scale_px = np.maximum(np.abs(xy).max(axis=0), 1.0)
    held, wanted = moments(points, scale_px, degree), moments(xy, scale_px, degree).T @ charges
    basis, sizes, mix = np.linalg.svd(held, full_matrices=False)
    kept = sizes > _LEAST_MOMENT * sizes[0]
    wanted = mix @ wanted
    if degree and np.abs(wanted[~kept]).max(initial=0.0) > _LEAST_MOMENT * np.abs(charges).sum():
        return _independent(points, xy, charges, degree - 1)
    return basis[:, kept], wanted[kept] / sizes[kept, None]
