"""Where between the slices of a stack each sparse point is sharpest: the peak of its sharpness over the focus, in dioptres.

The measure is the local energy of a band-passed picture; its logarithm is a parabola near the focus, in dioptres, because blur
grows in proportion to them (Nayar and Nakagawa 1994, Shape from Focus, take a normal curve for the same reason).
"""

from collections.abc import Iterable
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float, Float32, Int

from mrbokeh.images.color import luminance

_SMOOTHING_PX = 0.7
_WINDOW_PX = 4.0
_REACH = 3
_LEAST_RISE = float(np.log(3.0))

Curves = Float[np.ndarray, "slices points"]


@dataclass(frozen=True)
class SharpnessPeaks:
    """Log energies of the points that have a peak inside the stack, and the slice that is highest."""

    points: Int[np.ndarray, " peaks"]
    log_energy: Float[np.ndarray, "slices peaks"]
    highest: Int[np.ndarray, " peaks"]

    def dioptres(self, focus_dioptres: Float[np.ndarray, " slices"]) -> Float[np.ndarray, " peaks"]:
        """Vertices of parabolas through up to three slices on either side of the highest, placed at their focus; NaN where one
        opens upwards. As many on one side as on the other: the curve is wider than a parabola, which would pull the vertex. Slices whose
        focus is NaN are none of them, and what is sharpest there has no vertex."""
        vertices = np.full(len(self.points), np.nan)
        for slice_index in np.unique(self.highest):
            mine = self.highest == slice_index
            reach = _reach(np.isfinite(focus_dioptres), int(slice_index))
            if reach == 0:
                continue
            near = np.arange(slice_index - reach, slice_index + reach + 1)
            weight = np.sqrt(1.0 + reach - np.abs(near - slice_index))
            x = focus_dioptres[near] - focus_dioptres[slice_index]
            design = np.stack([np.ones_like(x), x, x**2], axis=1) * weight[:, None]
            _, slope, bend = np.linalg.lstsq(design, weight[:, None] * self.log_energy[np.ix_(near, mine)], rcond=None)[0]
            with np.errstate(divide="ignore", invalid="ignore"):
                vertex = np.where(bend < 0, -0.5 * slope / bend, np.nan)
            inside = (vertex >= x.min()) & (vertex <= x.max())
            vertices[mine] = focus_dioptres[slice_index] + np.where(inside, vertex, np.nan)
        return vertices


def _reach(known: Bool[np.ndarray, " slices"], middle: int) -> int:
    """How many neighbours on either side are known without a gap, up to _REACH; 0 where the middle itself is not."""
    reaches = (n for n in range(_REACH, 0, -1) if middle >= n and middle + n < len(known) and known[middle - n : middle + n + 1].all())
    return next(reaches, 0)


def sharpness_curves(slices: Iterable[Float32[np.ndarray, "height width 3"]], xy_px: Float[np.ndarray, "points 2"]) -> Curves:
    """Energy of each point in each registered slice (linear RGB); one slice is held at a time."""
    places = (xy_px - 0.5).astype(np.float32)
    rows = []
    for rgb in slices:
        detail = cv2.Laplacian(cv2.GaussianBlur(luminance(rgb), (0, 0), _SMOOTHING_PX), cv2.CV_32F)
        energy = cv2.GaussianBlur(detail**2, (0, 0), _WINDOW_PX)
        rows.append(cv2.remap(energy, places[:, 0], places[:, 1], cv2.INTER_LINEAR).ravel())
    return np.array(rows, np.float64)


def sharpness_peaks(curves: Curves) -> SharpnessPeaks:
    """Points whose sharpest slice is neither the first nor the last, and at least thrice as sharp as the least sharp."""
    log_energy = np.log(np.maximum(curves, 1e-20))
    highest = np.argmax(log_energy, axis=0)
    inside = (highest > 0) & (highest < len(curves) - 1)
    rise = log_energy.max(axis=0) - log_energy.min(axis=0)
    points = np.flatnonzero(inside & (rise > _LEAST_RISE))
    return SharpnessPeaks(points, log_energy[:, points], highest[points])
