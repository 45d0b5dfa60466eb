"""The best values for given points of a spreadlet: least squares over the whole plane, with the moments of light kept.

A kernel f with Laplacian L = D f is replaced by the sum of v_j at points p_j; what is seen is G v, with G the inverse of D.
The squared error is |G (L - v)|^2 = (L - v) K (L - v), K = G G: the Green's function of the squared Laplacian, r^2 log r / (8 pi)
far away. K grows, so the error is finite only if L - v has neither charge nor dipole: thin-plate splines in other clothes.

What the moments of L mean, by Green's second identity, sum(L p) = sum(f D p) for every polynomial p:
- D 1 = D x = D y = 0: charge and dipole of L are 0, else a spreadlet would shine to infinity as log r or 1 / r;
- D (x^2 + y^2) = 4: sum of L (x^2 + y^2) / 4 is the light of f, 1 for a PSF;
- D (x (x^2 + y^2)) = 8 x: it gives the centroid of the light, and y likewise;
- x^2 - y^2, x y, x^3 - 3 x y^2, 3 x^2 y - y^3 are harmonic: 0 for L, else light far outside the kernel falls as 1 / r^2, 1 / r^3.
The 3x3 stencil has these Laplacians exactly. So all ten moments up to degree 3 of v are set equal to those of L: light and
centroid are exact, and what shines outside falls as 1 / r^4.
"""

from functools import lru_cache

import numpy as np
from jaxtyping import Float64, Int16, Int64
from scipy.ndimage import map_coordinates, spline_filter

from mrbokeh.renderers.kernels.laplacian_integration import fast_width, integrate

_DOMAIN = 4  # the table's domain over its reach: what the border adds to K is smooth, and polynomials up to degree 7 cancel
_POINTS_PER_MOMENT = 3
_LEAST_MOMENT = 1e-9


@lru_cache(maxsize=8)
def biharmonic_table(reach_px: int) -> Float64[np.ndarray, "side side"]:
    """K by whole distances [|y|, |x|] from 0 to reach_px, up to terms that the moments cancel."""
    half = fast_width(_DOMAIN // 2 * reach_px + 2)
    source = np.zeros((2 * half + 1, 2 * half + 1, 1))
    source[half, half] = 1.0
    twice = integrate(integrate(source))[half : half + reach_px + 1, half : half + reach_px + 1, 0]
    return np.ascontiguousarray(0.5 * (twice + twice.T))


def potential_of(charges: Float64[np.ndarray, "size size channels"], table: Float64[np.ndarray, "side side"]) -> np.ndarray:
    """K L on the pixels of L; the table must reach across."""
    reach = charges.shape[0] - 1
    quarter = table[: reach + 1, : reach + 1]
    half = np.concatenate([quarter[:0:-1], quarter])
    kernel = np.concatenate([half[:, :0:-1], half], axis=1)
    # Here, for this import takes a second.
    from scipy.signal import fftconvolve

    return fftconvolve(charges, kernel[..., None], mode="same", axes=(0, 1)) if reach else charges * table[0, 0]


def table_for(size: int) -> Float64[np.ndarray, "side side"]:
    """A table for Laplacians of this many pixels across; sizes share tables."""
    return biharmonic_table(1 << int(np.ceil(np.log2(max(size, 16)))))


def moments(xy: np.ndarray, scale_px: float | np.ndarray, degree: int) -> Float64[np.ndarray, "points moments"]:
    """Monomials up to a degree at every point, in units of scale_px, one for both axes or one for each."""
    x, y = (xy / scale_px).T
    return np.stack([x ** (total - j) * y**j for total in range(degree + 1) for j in range(total + 1)], axis=1)


def fitted_values(
    points: Int64[np.ndarray, "points 2"],
    xy: Int64[np.ndarray, "pixels 2"],
    charges: Float64[np.ndarray, "pixels channels"],
    potential: Float64[np.ndarray, "size size channels"],
    table: Float64[np.ndarray, "side side"],
) -> Float64[np.ndarray, "points channels"]:
    """Values at the points with the least squared error among those that keep the moments of the charges."""
    radius_px = potential.shape[0] // 2
    return _solved(points, xy, charges, potential[points[:, 1] + radius_px, points[:, 0] + radius_px], table)


def turned(
    points: Int16[np.ndarray, "points 2"], values: Float64[np.ndarray, "points channels"], angle_rad: float
) -> tuple[Int16[np.ndarray, "places 2"], Float64[np.ndarray, "places channels"]]:
    """A spreadlet turned from x towards y: points at the nearest whole pixels with values fitted to where they should be.

    Rounding alone would give every point a dipole; as the moments are fitted, light and centroid stay exact here, too.
    """
    cosine, sine = np.cos(angle_rad), np.sin(angle_rad)
    wanted = points @ np.array([[cosine, sine], [-sine, cosine]])
    places = np.unique(np.rint(wanted).astype(np.int64), axis=0)
    if abs(wanted - np.rint(wanted)).max() < 1e-9:
        order = np.lexsort((np.rint(wanted[:, 1]), np.rint(wanted[:, 0])))
        return places.astype(np.int16), values[order]
    table = table_for(2 * int(np.abs(wanted).max() + 2.0) + 1)
    apart = np.abs(places[:, None] - wanted)
    between = map_coordinates(_spline(len(table)), [apart[..., 1], apart[..., 0]], order=3, mode="mirror", prefilter=False)
    return places.astype(np.int16), _solved(places, wanted, values, between @ values, table)


@lru_cache(maxsize=8)
def _spline(side: int) -> Float64[np.ndarray, "side side"]:
    """Coefficients that make a table of this size smooth between whole distances."""
    return spline_filter(biharmonic_table(side - 1), order=3, mode="mirror")


def _solved(
    points: Int64[np.ndarray, "points 2"],
    xy: np.ndarray,
    charges: Float64[np.ndarray, "pixels channels"],
    potential: Float64[np.ndarray, "points channels"],
    table: Float64[np.ndarray, "side side"],
) -> Float64[np.ndarray, "points channels"]:
    """Values at points (N, 2) for charges at xy (M, 2), whose potential at the points is known.

    Moments up to degree 3 are kept with at least 30 points; fewer points keep fewer moments, at least the charge. Points in few
    rows, as those of a line, cannot have all of them on their own (y^3 = y in rows -1, 0 and 1): `_independent`.
    """
    from mrbokeh.renderers.kernels._spreadlets_numba import solve

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
    """Combinations of moments that the points can have independently, and what the charges have of them.

    A lower degree where the charges have a moment that the points cannot have.
    """
    scale_px = np.maximum(np.abs(xy).max(axis=0), 1.0)
    held, wanted = moments(points, scale_px, degree), moments(xy, scale_px, degree).T @ charges
    basis, sizes, mix = np.linalg.svd(held, full_matrices=False)
    kept = sizes > _LEAST_MOMENT * sizes[0]
    wanted = mix @ wanted
    if degree and np.abs(wanted[~kept]).max(initial=0.0) > _LEAST_MOMENT * np.abs(charges).sum():
        return _independent(points, xy, charges, degree - 1)
    return basis[:, kept], wanted[kept] / sizes[kept, None]
