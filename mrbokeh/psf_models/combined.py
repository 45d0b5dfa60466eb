"""COMBINED: defocus and motion, a disc swept along a line during the shutter (Leimkuehler 2018, Section 5.1)."""

from typing import Any

import numpy as np
from jaxtyping import Float64

from mrbokeh.psf import kernel_radius_px
from mrbokeh.psf_bank import Axis, Turns
from mrbokeh.psf_models.base import Kernel, check_positive, nodes
from mrbokeh.psf_models.quasi_random import sobol_blocks

EXPONENTS = (2.0, 1.0)
COUNTS = (75, 75)
LARGEST_PX = 256.0
_STEPS_PX = (0.25, 1.0)
"""Diameters and motions of the closed form lie so near to one another when it is averaged: eight of them or the wider step."""


class Combined:
    """A thin lens with a round opening before a point that moves evenly in a straight line: a capsule with soft ends.

    Coordinates: the diameter of the circle of confusion and the length of the path per shutter, without its direction (by
    which the kernel is turned where it is used). The source in the middle of the kernel is the point at half time.
    diameter_px, motion_px: the largest of the bank (256 each fill the paper's 512 pixels). counts: steps of the nested grid;
    75 x 75 give 392 cells, where the paper's Table 1 has 400.
    """

    name = "combined"
    turns: Turns = "motion"
    near_side_turned = False
    channels = 1
    default_rays = 0

    def __init__(self, diameter_px: float = LARGEST_PX, motion_px: float = LARGEST_PX, counts: tuple[int, ...] = COUNTS) -> None:
        self.axes = (
            Axis("diameter_px", 0.0, check_positive("the largest diameter of combined blur", diameter_px), EXPONENTS[0]),
            Axis("motion_px", 0.0, check_positive("the longest motion of combined blur", motion_px), EXPONENTS[1]),
        )
        self.counts = counts

    @property
    def settings(self) -> dict[str, Any]:
        return {}

    def kernel(self, box: Float64[np.ndarray, "axes 2"], rays: int, seed: int) -> Kernel:
        """See `PsfModel.kernel`."""
        from mrbokeh.psf_models._combined_numba import fill_capsule, trace_capsule

        size = _size(float(box[0, 1]), float(box[1, 1]))
        total = np.zeros((size, size))
        if rays:
            total /= sum(trace_capsule(total, np.ascontiguousarray(box), shares) for shares in sobol_blocks(5, rays, seed))
        else:
            diameters, motions = (
                nodes(axis, low, high, _step_px(high - low)) for axis, (low, high) in zip(self.axes, box.tolist(), strict=True)
            )
            for diameter_px in diameters.tolist():
                for motion_px in motions.tolist():
                    fill_capsule(total, diameter_px, motion_px, 1.0 / (len(diameters) * len(motions)))
        return np.maximum(total, 0.0)[..., None].astype(np.float32)

    def exact(self, coords: Float64[np.ndarray, " axes"]) -> Kernel:
        """The capsule with its true profile: over a pixel, the light of the disc during the time in which it covers it."""
        return self.kernel(np.stack([coords, coords], axis=1), 0, 0)


def _step_px(width_px: float) -> float:
    return min(max(width_px / 8.0, _STEPS_PX[0]), _STEPS_PX[1])


def _size(diameter_px: float, motion_px: float) -> int:
    return 2 * kernel_radius_px(abs(diameter_px) + motion_px) + 1
