"""COMBINED: defocus and motion, a disc swept along a line during the shutter (Leimkuehler 2018, Section 5.1).

What a bank is worth (`python -m tests.bench.bench_combined_bank`): the overlap (sum of the smaller of both) of a cell's
kernel with the exact one at 1,000 random places, mean and worst of 20. The L1 distance is twice what it lacks to 1.

                                       even over 256 x 256 px     even over octaves from 0.5 px
    paper's nested grid, 392 cells     0.928, 0.849               0.897, 0.739
    `ProportionalGrid`, 388 cells      0.951, 0.912               0.932, 0.874
    paper's nested grid, 1986 cells    0.962, 0.921               0.950, 0.865
    `ProportionalGrid`, 1989 cells     0.977, 0.959               0.970, 0.943

With about 400 cells, by circle (down: 0.5 to 2, 8, 32 and 256 px) and motion (across: the same), the paper's on the left:

    0.801 0.791 0.815 0.884      0.901 0.898 0.920 0.921
    0.929 0.891 0.850 0.871      0.942 0.921 0.929 0.932
    0.954 0.932 0.897 0.867      0.932 0.939 0.945 0.936
    0.975 0.960 0.945 0.927      0.927 0.937 0.951 0.953

Where the paper's loses: mostly in the diameter (with the motion exact 0.934 are left of the 0.928, with the diameter exact
0.982), most of all for small circles in long motion; the prefilter costs 0.003. It is the better one for large circles that
hardly move, of which it has many kernels that differ little.
"""

from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
from jaxtyping import Float64

from mrbokeh.optics.psf import kernel_radius_px
from mrbokeh.optics.psf_bank import Axis, Turns
from mrbokeh.optics.psf_grid import ProportionalGrid
from mrbokeh.psf_models.base import Kernel, check_positive, nodes, sobol_blocks

CELLS = 400
LARGEST_PX = 256.0
PAPER_EXPONENTS, PAPER_COUNTS = (2.0, 1.0), (75, 75)
"""Table 1's power remapping; 75 x 75 steps of the nested grid give 392 cells, where the table has 400."""
_KNEE_PX, _STEP_RATIO = 5.0, 2.0
_STEPS_PX = (0.25, 1.0)
"""Diameters and motions of the closed form lie so near to one another when it is averaged: eight of them or the wider step."""


class Combined:
    """Thin lens with a round opening before a point that moves evenly in a straight line: a capsule with soft ends.

    Coordinates: the diameter of the circle of confusion and the length of the path per shutter, without its direction (by
    which the kernel is turned where it is used). The source in the middle of the kernel is the point at half time.
    diameter_px, motion_px: the largest of the bank (256 each fill the paper's 512 pixels). cells: at most so many, laid out in
    proportion (`ProportionalGrid`). counts: steps of the paper's nested grid instead; PAPER_COUNTS make that of its Table 1.
    """

    name = "combined"
    turns: Turns = "motion"
    near_side_turned = False
    channels = 1
    default_rays = 0

    def __init__(
        self,
        diameter_px: float = LARGEST_PX,
        motion_px: float = LARGEST_PX,
        counts: tuple[int, ...] | None = None,
        cells: int = CELLS,
        device: str = "",
    ) -> None:
        self.device = device
        largest_px = check_positive("the largest diameter of combined blur", diameter_px)
        longest_px = check_positive("the longest motion of combined blur", motion_px)
        exponents = (1.0, 1.0) if counts is None else PAPER_EXPONENTS
        self.axes = (Axis("diameter_px", 0.0, largest_px, exponents[0]), Axis("motion_px", 0.0, longest_px, exponents[1]))
        self.knee_px = _KNEE_PX if counts is None else None
        self.counts = counts or ProportionalGrid.of_cells(cells, (largest_px, longest_px), _KNEE_PX, _STEP_RATIO).counts

    @property
    def settings(self) -> dict[str, Any]:
        return {}

    def kernel(self, box: Float64[np.ndarray, "axes 2"], rays: int, seed: int) -> Kernel:
        """See `PsfModel.kernel`."""
        from mrbokeh.psf_models._lens_points_numba import fill_capsule

        size = _size(float(box[0, 1]), float(box[1, 1]))
        total = np.zeros((size, size))
        if rays:
            trace, box = _tracer(self.device), np.ascontiguousarray(box)
            total /= sum(trace(total, box, shares) for shares in sobol_blocks(5, rays, seed, self.device))
        else:
            diameters, motions = (
                nodes(axis, low, high, _step_px(high - low)) for axis, (low, high) in zip(self.axes, box.tolist(), strict=True)
            )
            for diameter_px in diameters.tolist():
                for motion_px in motions.tolist():
                    fill_capsule(total, diameter_px, motion_px, 1.0 / (len(diameters) * len(motions)))
        return np.maximum(total, 0.0)[..., None].astype(np.float32)

    def exact(self, coords: Float64[np.ndarray, " axes"]) -> Kernel:
        """Return the capsule with its true profile: over a pixel, the light of the disc during the time in which it covers it."""
        return self.kernel(np.stack([coords, coords], axis=1), 0, 0)


def _tracer(device: str) -> Callable[..., float]:
    if device:
        from mrbokeh.psf_models.torch_tracing import trace_capsule as trace_on

        return partial(trace_on, device)
    from mrbokeh.psf_models._lens_points_numba import trace_capsule

    return trace_capsule


def _step_px(width_px: float) -> float:
    return min(max(width_px / 8.0, _STEPS_PX[0]), _STEPS_PX[1])


def _size(diameter_px: float, motion_px: float) -> int:
    return 2 * kernel_radius_px(abs(diameter_px) + motion_px) + 1
