"""Evidence: the normal equations of many pixels, for every knot and colour."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Float32, Float64, Int64

_HUBER = 1.345
_LEAST_DEVIATION = 1e-3  # no slice is known better than this, over the root of its radiance
DARK = 0.02
"""The variance of a pixel is taken in proportion to its radiance plus this: photons, and what a sensor adds."""

Rows = Float32[np.ndarray, "rows channels cells"]
Pictures = Float[np.ndarray, "knots channels cells"]


@dataclass(frozen=True)
class Equations:
    """Pixels of one slice or light: target = rows @ picture of the pupil, for each colour.

    Both without the pixel's mean over the pupil: pictures sum to 1, so that nothing is lost, and the brightness of a place, which says
    nothing about the shape of the blur, does not drown what does. weights: inverse variance, but for a factor that the slice has in
    common. knots: to which each pixel belongs.
    """

    rows: Rows
    targets: Float64[np.ndarray, "rows channels"]
    weights: Float64[np.ndarray, "rows channels"]
    knots: Int64[np.ndarray, " rows"]

    def residuals(self, pictures: Pictures) -> Float64[np.ndarray, "rows channels"]:
        """Target minus prediction."""
        out = self.targets.copy()
        for knot in np.unique(self.knots):
            mine = self.knots == knot
            out[mine] -= np.einsum("rcp,cp->rc", self.rows[mine], pictures[knot].astype(np.float32), optimize=True)
        return out

    def error(self, pictures: Pictures) -> float:
        """Root mean square of what is left, over the square root of radiance (as noise is)."""
        return float(np.sqrt((self.residuals(pictures) ** 2 * self.weights).mean()))

    def robust(self, pictures: Pictures) -> Float64[np.ndarray, "rows channels"]:
        """Weights that are 1 over the variance found, less (Huber 1964) for pixels that disagree."""
        size = np.abs(self.residuals(pictures)) * np.sqrt(self.weights)
        deviation = max(1.4826 * float(np.median(size)), _LEAST_DEVIATION)
        share = np.minimum(1.0, _HUBER * deviation / np.maximum(size, 1e-12))
        return np.asarray(self.weights * share / deviation**2)


@dataclass
class Evidence:
    """matrices (K, C, cells, cells) A'WA, sides (K, C, cells) A'Wy, energies (K,) y'Wy, counts (K,): pixels of each knot."""

    matrices: Float32[np.ndarray, "knots channels cells cells"]
    sides: Float64[np.ndarray, "knots channels cells"]
    energies: Float64[np.ndarray, " knots"]
    counts: Int64[np.ndarray, " knots"]

    @classmethod
    def none(cls, knots: int, channels: int, cells: int) -> "Evidence":
        return cls(
            np.zeros((knots, channels, cells, cells), np.float32),
            np.zeros((knots, channels, cells)),
            np.zeros(knots),
            np.zeros(knots, np.int64),
        )

    def add(self, equations: Equations, weights: Float64[np.ndarray, "rows channels"]) -> None:
        for knot in np.unique(equations.knots):
            mine = equations.knots == knot
            self.counts[knot] += int(mine.sum())
            self.energies[knot] += float((weights[mine] * equations.targets[mine] ** 2).sum())
            for channel in range(equations.targets.shape[1]):
                rows = equations.rows[mine, channel]
                weighted = rows * np.sqrt(weights[mine, channel], dtype=np.float32)[:, None]
                self.matrices[knot, channel] += weighted.T @ weighted
                self.sides[knot, channel] += rows.T @ (weights[mine, channel] * equations.targets[mine, channel])

    def errors(self, pictures: Pictures) -> Float64[np.ndarray, " knots"]:
        """What is left of each knot's pixels (root mean square), in typical deviations of their slice; nan where there are none."""
        explained = np.matmul(self.matrices, pictures[..., None].astype(np.float32))[..., 0] - 2.0 * self.sides
        left = self.energies + (explained * pictures).sum(axis=(1, 2))
        of = np.where(self.counts > 0, self.counts * self.sides.shape[1], np.nan)
        return np.asarray(np.sqrt(np.maximum(left, 0.0) / of))
