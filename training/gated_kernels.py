"""The kernels that the gated form begins with."""

import math
from dataclasses import replace

import numpy as np
import torch
from torch import Tensor

from mrbokeh.optics.aperture import Aperture

FLAT_SHARE, FLAT_SHARE_IN_FOCUS = 0.05, 0.005  # of a fresh kernel, so that every one of its pixels can learn
# Several bases of a bin must begin apart, or they would all learn the same: discs clipped from different sides, as cat-eyes are, on
# floors that lean to these sides (in focus, where a disc has no shape, the floor alone). Their mean leans nowhere.
CAT_EYE, LEAN = 0.6, 0.5


def disc_kernel(size: int, diameter_px: float) -> Tensor:
    """(size, size): a disc with exact pixel coverage, sum 1."""
    return _kernel(Aperture.disc(sides=64), size, diameter_px)


def fresh_kernels(n: int, knots_px: list[float], bases: int, initialisation: str) -> Tensor:
    """(bins * bases, 2n+1, 2n+1), bases fastest: a kernel is their magnitude over its sum; a typical one is 1.

    knots_px: signed diameters of the bins that have this size. Discs, or by "default" flat squares.
    """
    size = 2 * n + 1
    share = 1.0 if initialisation != "disc" else FLAT_SHARE_IN_FOCUS if n == 1 else FLAT_SHARE
    openings, floors = _openings(bases), _floors(n, bases)
    kernels = [
        (1.0 - share) * _kernel(opening, size, max(1.0, abs(knot))) + share * floor
        for knot in knots_px
        for opening, floor in zip(openings, floors, strict=True)
    ]
    return torch.stack(kernels) * size**2


def _kernel(opening: Aperture, size: int, diameter_px: float) -> Tensor:
    kernel = np.zeros((size, size), np.float32)
    psf = opening.rasterize(min(diameter_px, 0.98 * size)).kernel
    margin = (size - psf.shape[0]) // 2
    kernel[margin : size - margin, margin : size - margin] = psf
    return torch.from_numpy(kernel)


def _sides(bases: int) -> list[tuple[float, float]]:
    """Evenly spread directions, one for each base; none for a single one."""
    angles = [2.0 * math.pi * base / bases for base in range(bases)]
    return [(math.cos(angle), math.sin(angle)) for angle in angles] if bases > 1 else [(0.0, 0.0)]


def _openings(bases: int) -> list[Aperture]:
    disc = Aperture.disc(sides=64)
    return [replace(disc, cat_eye=CAT_EYE).seen(1, side) for side in _sides(bases)] if bases > 1 else [disc]


def _floors(n: int, bases: int) -> list[Tensor]:
    """Each (2n+1, 2n+1), sum 1, LEAN more at its own side than in the middle."""
    along = torch.arange(-n, n + 1) / n
    return [(1.0 + LEAN * (x * along + y * along[:, None]) / math.sqrt(2.0)) / (2 * n + 1) ** 2 for x, y in _sides(bases)]
