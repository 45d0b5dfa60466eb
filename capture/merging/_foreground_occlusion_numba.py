"""Compiled gathering of nearer surfaces out of focus over their circles of confusion."""

import numpy as np

from mrbokeh.system.compiled import njit


@njit(cache=True, fastmath=True)
def gather_foreground(
    dioptres: np.ndarray,
    rgb: np.ndarray,
    focus_dioptre: float,
    px_per_dioptre: float,
    kernels: np.ndarray,
    kernels_per_px: float,
    wanted: np.ndarray,
    least_step: float,
    cover: np.ndarray,
    light: np.ndarray,
) -> None:
    """Fill cover (H, W) and light (H, W, 3) where wanted: the share of the pupil that nearer surfaces block, and their light.

    kernels (N, K, K): the pupil's picture at diameters 0, 1, 2, ... / kernels_per_px, each of sum 1.
    """
    height, width = dioptres.shape
    radius = kernels.shape[1] // 2
    last = kernels.shape[0] - 1
    for y in range(height):
        for x in range(width):
            if not wanted[y, x]:
                continue
            nearer_than = dioptres[y, x] + least_step
            share, red, green, blue = 0.0, 0.0, 0.0, 0.0
            for j in range(max(0, y - radius), min(height, y + radius + 1)):
                for i in range(max(0, x - radius), min(width, x + radius + 1)):
                    if dioptres[j, i] <= nearer_than:
                        continue
                    coc_px = px_per_dioptre * (focus_dioptre - dioptres[j, i])
                    kernel = min(int(abs(coc_px) * kernels_per_px + 0.5), last)
                    sign = 1 if coc_px > 0 else -1
                    weight = kernels[kernel, radius + sign * (y - j), radius + sign * (x - i)]
                    share += weight
                    red += weight * rgb[j, i, 0]
                    green += weight * rgb[j, i, 1]
                    blue += weight * rgb[j, i, 2]
            cover[y, x] = share
            light[y, x, 0] = red
            light[y, x, 1] = green
            light[y, x, 2] = blue
