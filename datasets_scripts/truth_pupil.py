"""Uniform points in an aperture of any shape: two numbers in [0, 1) to a point of the unit pupil."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Float32

from mrbokeh.optics.aperture import Aperture
from mrbokeh.system.errors import InputError

_SCANLINES = 1 << 16
_BANDS = 1 << 14


@dataclass(frozen=True, eq=False)
class PupilTable:
    """An aperture cut into horizontal bands of equal area.

    bands: (B, 2 + 2 S), y at the top and at the bottom of each band, then the S spans (left, right) of the aperture along the
    line that halves its area. A band is so thin (1/16384 of the area) that its slanted ends do not matter.
    """

    bands: Float32[np.ndarray, "bands columns"]

    @property
    def spans(self) -> int:
        return self.bands.shape[1] // 2 - 1

    def points(self, along: Float[np.ndarray, " n"], across: Float[np.ndarray, " n"]) -> Float[np.ndarray, "n 2"]:
        """(N, 2) points x, y: `across` chooses the band and the height within it, `along` the place on its spans."""
        scaled = across * len(self.bands)
        row = self.bands[np.minimum(scaled.astype(int), len(self.bands) - 1)].astype(np.float64)
        y = row[:, 0] + (scaled % 1.0) * (row[:, 1] - row[:, 0])
        widths = row[:, 3::2] - row[:, 2::2]
        left = along * widths.sum(axis=1)
        x = row[:, 2] + left
        for index in range(1, self.spans):
            left = left - widths[:, index - 1]
            x = np.where(left > 0, row[:, 2 + 2 * index] + left, x)
        return np.stack([x, y], axis=1)


def pupil_table(aperture: Aperture) -> PupilTable:
    """The table of an aperture that passes all or nothing at every point: outlines of weight +1 and stops of weight -1."""
    if not all(abs(weight) == 1.0 for weight in aperture.weights):
        raise InputError(f"the ray tracer takes apertures that are open or closed (weights +1 and -1), got weights {aperture.weights}")
    every_y = np.concatenate([outline[:, 1] for outline in aperture.outlines])
    edges = np.linspace(every_y.min(), every_y.max(), _SCANLINES + 1)
    crossings = _crossings(aperture, 0.5 * (edges[1:] + edges[:-1]))
    area = np.concatenate([[0.0], np.cumsum((crossings[:, 1::2] - crossings[:, ::2]).sum(axis=1))])
    y = np.interp(np.linspace(0.0, area[-1], 2 * _BANDS + 1), area, edges)
    columns = [y[:-2:2, None], y[2::2, None], _crossings(aperture, y[1::2])]
    return PupilTable(np.concatenate(columns, axis=1).astype(np.float32))


def _crossings(aperture: Aperture, y: Float[np.ndarray, " rows"]) -> Float[np.ndarray, "rows crossings"]:
    """Sorted x at which each line y enters and leaves the aperture; lines with fewer spans are filled up with empty ones."""
    found = []
    for outline in aperture.outlines:
        for (x0, y0), (x1, y1) in zip(outline, np.roll(outline, -1, axis=0), strict=True):
            inside = (y >= min(y0, y1)) & (y < max(y0, y1))
            slope = (x1 - x0) / (y1 - y0) if y1 != y0 else 0.0
            found.append(np.where(inside, x0 + slope * (y - y0), np.inf))
    crossings = np.sort(np.stack(found, axis=1), axis=1)
    finite = np.isfinite(crossings)
    crossings, finite = crossings[:, : finite.sum(axis=1).max()], finite[:, : finite.sum(axis=1).max()]
    last = np.max(np.where(finite, crossings, -np.inf), axis=1, keepdims=True)
    return np.where(finite, crossings, np.where(np.isfinite(last), last, 0.0))


def two_disc_overlap(distance: Float[np.ndarray, "*batch"]) -> Float[np.ndarray, "*batch"]:
    """Share of a unit disc that a second unit disc covers, their centres `distance` apart."""
    half = np.clip(np.abs(distance) / 2.0, 0.0, 1.0)
    return (np.arccos(half) - half * np.sqrt(1.0 - half**2)) * 2.0 / np.pi
