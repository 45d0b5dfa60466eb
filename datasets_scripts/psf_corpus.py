"""The test set of Leimkuehler et al. 2018, Section 7.3: kernels of COMBINED, and how sparse and how alike their sparse forms are."""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import islice

import numpy as np
from jaxtyping import Float, Float64

from datasets_scripts.psf_quad_tree import QuadTree
from mrbokeh.images.image_metrics import ssim
from mrbokeh.optics.psf_bank import physical_boxes
from mrbokeh.optics.psf_grid import NestedGrid
from mrbokeh.psf_models.combined import Combined
from mrbokeh.renderers.kernels.laplacian_integration import integrate
from mrbokeh.renderers.kernels.spreadlets import Spreadlet

COUNTS = (75, 75)
"""Steps of the nested grid with 392 cells; the paper has 400."""

Kernel = Float64[np.ndarray, "size size"]
Window = Float64[np.ndarray, "window window"]


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
    """sparsity: points over taps, at most 1 (with as many the kernel is splatted as it is). similarity: SSIM within the window that
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
    """Whether all light lies in one row."""
    return bool(np.count_nonzero(kernel.any(axis=1)) == 1)


def likeness_of(sparse: Spreadlet | QuadTree, kernel: Kernel, window_px: int) -> Likeness:
    """A sparse form against its kernel."""
    points = len(sparse.values)
    taps = int(np.count_nonzero(kernel))
    if points >= taps:
        return Likeness(1.0, 1.0, 1.0, 0.0)
    found, truth = picture_of(sparse, window_px), around(kernel, window_px)
    return Likeness(points / taps, *alike(found, truth, len(kernel)))


def alike(found: Window, truth: Window, near_px: int) -> tuple[float, float, float]:
    """SSIM with the truth's peak as 1, within the window and within near_px around its middle; L1."""
    peak = float(truth.max())
    wide, wide_truth = np.pad(found, _SSIM_BORDER_PX) / peak, np.pad(truth, _SSIM_BORDER_PX) / peak
    first = len(truth) // 2 - near_px // 2
    near = slice(first, first + near_px + 2 * _SSIM_BORDER_PX)
    return ssim(wide, wide_truth), ssim(wide[near, near], wide_truth[near, near]), float(np.abs(found - truth).sum())


_SSIM_BORDER_PX = 5  # that SSIM leaves out


def picture_of(sparse: Spreadlet | QuadTree, window_px: int) -> Window:
    """The kernel that a sparse form stands for, in the middle of a window (odd)."""
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


_FAR_PX = 8  # to the border on which light is 0, as renderers have it


def around(kernel: Kernel, window_px: int) -> Window:
    """The kernel with zeros around it."""
    return np.pad(kernel, (window_px - len(kernel)) // 2)


def mean_of(found: Sequence[Likeness]) -> dict[str, float]:
    """Means, and the paper's efficiency: similarity over sparsity."""
    names = ("sparsity", "similarity", "similarity_near", "l1")
    means = {name: float(np.mean([getattr(each, name) for each in found])) for name in names}
    return {**means, "efficiency": means["similarity"] / means["sparsity"]}
