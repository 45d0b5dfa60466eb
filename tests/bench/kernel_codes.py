"""Sparse codes of kernels compared: quad trees beside spreadlets, and the test set of Leimkuehler et al. 2018, Section 7.3.

`quad_tree` is theirs: squares of even light, split where they fit worst; each square that is not dark is one splat, into the level
of a pyramid that has its size. `quad_tree_points` keeps to the Laplacian and takes the squares of a tree, split where most charge
is, in place of the Voronoi cells of darts. The test set are kernels of COMBINED.
"""

import heapq
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from itertools import islice

import numpy as np
from jaxtyping import Float, Float64, Int64

from mrbokeh.images.image_metrics import ssim
from mrbokeh.optics.psf_bank import physical_boxes
from mrbokeh.optics.psf_grid import NestedGrid
from mrbokeh.psf_models.build import Combined
from mrbokeh.renderers.kernels.laplacian_integration import integrate, laplacian
from mrbokeh.renderers.kernels.spreadlets import Spreadlet, fitted_values, potential_of, table_for, whole_laplacian

_LEAST_LINES = 3
Square = tuple[int, int, int]
COUNTS = (75, 75)
"""Steps of the nested grid with 392 cells; the paper has 400."""
Kernel = Float64[np.ndarray, "size size"]
Window = Float64[np.ndarray, "window window"]
_SSIM_BORDER_PX = 5  # that SSIM leaves out
_FAR_PX = 8  # to the border on which light is 0, as renderers have it


@dataclass(frozen=True)
class QuadTree:
    """Leaves of a tree over a square picture of side_px: (N, 3) top, left, size in pixels and their values, N; dark ones are left out."""

    leaves: Int64[np.ndarray, "leaves 3"]
    values: Float64[np.ndarray, " leaves"]
    side_px: int

    def picture(self) -> Float64[np.ndarray, "side side"]:
        """Return the squares filled; the middle of the kernel is pixel (side / 2, side / 2)."""
        out = np.zeros((self.side_px, self.side_px))
        for (top, left, size), value in zip(self.leaves.tolist(), self.values, strict=True):
            out[top : top + size, left : left + size] = value
        return out


def quad_tree(kernel: Float[np.ndarray, "size size"], leaves: int) -> QuadTree:
    """Return a kernel (odd size) as so many squares that are not dark, or a few more; each holds the mean, so the light is kept.

    The leaf with the largest squared error is split first.
    """
    picture = _in_a_power_of_two(kernel.astype(np.float64))
    sums, squares = _Sums(picture), _Sums(picture**2)

    def error(square: Square) -> float:
        return squares.over(square) - sums.over(square) ** 2 / square[2] ** 2

    found = _split(len(picture), leaves, error, lambda square: sums.over(square) > 0.0)
    values = [sums.over(square) / square[2] ** 2 for square in found]
    return QuadTree(np.array(found, np.int64).reshape(-1, 3), np.array(values), len(picture))


def quad_tree_points(kernel: Float[np.ndarray, "size size"], points: int, fit: bool) -> Spreadlet:
    """Return the Laplacian gathered in squares: one point in each that is not empty, at the centroid of its charges.

    fit: values by least squares, as kernels.spreadlets has them, else the sums; points in three rows or columns or fewer cannot
    hold the moments that a fit keeps, and take the sums, too.
    """
    dense = laplacian(kernel[..., None])
    whole = whole_laplacian(kernel)
    xy, charges = whole.points.astype(np.int64), whole.values
    magnitude = _Sums(_in_a_power_of_two(np.abs(dense[..., 0])))
    squares = _split(magnitude.side, points, lambda square: magnitude.over(square) if square[2] > 1 else 0.0, magnitude.is_lit)
    owner = np.full((magnitude.side, magnitude.side), -1)
    for index, (top, left, size) in enumerate(squares):
        owner[top : top + size, left : left + size] = index
    mine = owner[xy[:, 1] + magnitude.side // 2, xy[:, 0] + magnitude.side // 2]
    places = _centroids(xy, np.abs(charges[:, 0]), mine, len(squares))
    sums = np.bincount(mine, charges[:, 0], len(squares))
    unique, where = np.unique(places, axis=0, return_inverse=True)
    values = np.bincount(where.reshape(-1), sums)[:, None]
    if fit and all(len(np.unique(axis)) > _LEAST_LINES for axis in unique.T):
        table = table_for(len(dense))
        values = fitted_values(unique, xy, charges, potential_of(dense, table), table)
    return Spreadlet(unique.astype(np.int16), values)


def _centroids(xy: np.ndarray, weights: np.ndarray, owner: np.ndarray, count: int) -> Int64[np.ndarray, "count 2"]:
    total = np.maximum(np.bincount(owner, weights, count), np.finfo(float).tiny)
    return np.stack([np.rint(np.bincount(owner, weights * xy[:, axis], count) / total).astype(np.int64) for axis in range(2)], axis=1)


def _split(side: int, wanted: int, error: Callable[[Square], float], is_lit: Callable[[Square], bool]) -> list[Square]:
    """Lit leaves of a tree that is split at the largest error until there are so many of them, or no error is left."""
    root = (0, 0, side)
    waiting, lit = [(-error(root), root)], int(is_lit(root))
    while lit < wanted and waiting[0][0] < 0.0 and waiting[0][1][2] > 1:
        _, square = heapq.heappop(waiting)
        children = list(_quarters(square))
        lit += sum(map(is_lit, children)) - int(is_lit(square))
        for child in children:
            heapq.heappush(waiting, (-error(child) if child[2] > 1 else 0.0, child))
    return sorted(square for _, square in waiting if is_lit(square))


def _quarters(square: Square) -> Iterator[Square]:
    top, left, half = square[0], square[1], square[2] // 2
    for down in (0, half):
        for right in (0, half):
            yield top + down, left + right, half


class _Sums:
    """Sums over squares of a picture, from its summed-area table (Crow 1984)."""

    def __init__(self, picture: Float64[np.ndarray, "side side"]) -> None:
        self.side = len(picture)
        self._table = np.pad(picture.cumsum(axis=0).cumsum(axis=1), ((1, 0), (1, 0)))

    def over(self, square: Square) -> float:
        top, left, size = square
        table, bottom, right = self._table, top + size, left + size
        return float(table[bottom, right] - table[top, right] - table[bottom, left] + table[top, left])

    def is_lit(self, square: Square) -> bool:
        return self.over(square) > 1e-12 * float(self._table[-1, -1])


def _in_a_power_of_two(picture: Float64[np.ndarray, "size size"]) -> Float64[np.ndarray, "side side"]:
    """Pad with zeros, so that the middle pixel is (side / 2, side / 2)."""
    radius = len(picture) // 2
    side = 1 << int(np.ceil(np.log2(2 * radius + 2)))
    out = np.zeros((side, side))
    part = slice(side // 2 - radius, side // 2 + radius + 1)
    out[part, part] = picture
    return out


@dataclass(frozen=True)
class Corpus:
    """Kernels of cells of the bank, drawn by chance, and the side of the picture that they are compared in.

    largest_px: range of both coordinates, 256 in the paper. All pictures are as wide as the largest kernel: 512 px there.
    Kernels of one row of pixels, motion without defocus, are left out: their Laplacian has more points than they have taps.
    """

    largest_px: float
    count: int
    seed: int = 0

    @property
    def window_px(self) -> int:
        return 2 * int(self.largest_px) + 1

    def kernels(self) -> list[np.ndarray]:
        model = Combined(self.largest_px, self.largest_px, COUNTS)
        boxes = physical_boxes(model.axes, NestedGrid(COUNTS))
        order = np.random.default_rng(self.seed).permutation(len(boxes))
        drawn = (clean(model.kernel(boxes[cell], 0, 0)) for cell in order)
        return list(islice((kernel for kernel in drawn if not is_line(kernel)), self.count))


@dataclass(frozen=True)
class Likeness:
    """Likeness of a sparse form to its kernel.

    sparsity: points over taps, at most 1 (with as many the kernel is splatted as it is). similarity: SSIM within the window that
    all kernels share, as the paper's; similarity_near: within the kernel's own square. l1: sum of absolute differences.
    """

    sparsity: float
    similarity: float
    similarity_near: float
    l1: float


def clean(kernel: Float[np.ndarray, "size size 1"]) -> Kernel:
    """One channel without rounding errors far below its peak."""
    values = kernel[..., 0].astype(np.float64)
    values[values < 1e-6 * values.max()] = 0.0
    return values / values.sum()


def is_line(kernel: Kernel) -> bool:
    """Return whether all light lies in one row."""
    return bool(np.count_nonzero(kernel.any(axis=1)) == 1)


def likeness_of(sparse: Spreadlet | QuadTree, kernel: Kernel, window_px: int) -> Likeness:
    """Compare a sparse form with its kernel."""
    points = len(sparse.values)
    taps = int(np.count_nonzero(kernel))
    if points >= taps:
        return Likeness(1.0, 1.0, 1.0, 0.0)
    found, truth = picture_of(sparse, window_px), around(kernel, window_px)
    return Likeness(points / taps, *alike(found, truth, len(kernel)))


def alike(found: Window, truth: Window, near_px: int) -> tuple[float, float, float]:
    """Return SSIM with the truth's peak as 1, within the window and within near_px around its middle; L1."""
    peak = float(truth.max())
    wide, wide_truth = np.pad(found, _SSIM_BORDER_PX) / peak, np.pad(truth, _SSIM_BORDER_PX) / peak
    first = len(truth) // 2 - near_px // 2
    near = slice(first, first + near_px + 2 * _SSIM_BORDER_PX)
    return ssim(wide, wide_truth), ssim(wide[near, near], wide_truth[near, near]), float(np.abs(found - truth).sum())


def picture_of(sparse: Spreadlet | QuadTree, window_px: int) -> Window:
    """Return the kernel that a sparse form stands for, in the middle of a window (odd)."""
    if isinstance(sparse, QuadTree):
        side = max(sparse.side_px, window_px + 1)
        picture = np.pad(sparse.picture(), (side - sparse.side_px) // 2)
        first = len(picture) // 2 - window_px // 2
        return picture[first : first + window_px, first : first + window_px]
    size = max(window_px, 2 * int(np.abs(sparse.points).max()) + 1) + 2 * _FAR_PX
    source = np.zeros((size, size, 1))
    x, y = sparse.points.T.astype(int) + size // 2
    np.add.at(source, (y, x), sparse.values)
    first = size // 2 - window_px // 2
    return integrate(source)[first : first + window_px, first : first + window_px, 0]


def around(kernel: Kernel, window_px: int) -> Window:
    """Return the kernel with zeros around it."""
    return np.pad(kernel, (window_px - len(kernel)) // 2)


def mean_of(found: Sequence[Likeness]) -> dict[str, float]:
    """Return means, and the paper's efficiency: similarity over sparsity."""
    names = ("sparsity", "similarity", "similarity_near", "l1")
    means = {name: float(np.mean([getattr(each, name) for each in found])) for name in names}
    return {**means, "efficiency": means["similarity"] / means["sparsity"]}
