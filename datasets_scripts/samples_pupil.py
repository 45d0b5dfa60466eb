"""Lens points in proportion to what an aperture passes: two numbers in [0, 1) to a point of the unit pupil."""

from itertools import pairwise

import numpy as np
from jaxtyping import Float, Int

from datasets_scripts._samples_random_numba import LensTable
from mrbokeh.optics.aperture import Aperture
from mrbokeh.optics.aperture_shapes import net_area
from mrbokeh.system.errors import InputError

_SCANLINES = 1 << 13
_BANDS = 1 << 12
_NEGATIVE = -1e-9


def lens_table(aperture: Aperture) -> LensTable:
    """Bands of equal light, each so thin (1/4096 of the light) that its slanted ends do not matter.

    y: (B, 2) top and bottom; x: (B, S + 1) where the transmission changes along the middle of the band; light: (B, S + 1) share
    of the band's light to the left of there, 0 to 1. Apertures of any weights that let no negative light through anywhere
    and that are the same all over the frame (`Aperture.is_plain`).
    """
    vertices, starts, weights = aperture.packed()
    edges = np.linspace(vertices[:, 1].min(), vertices[:, 1].max(), _SCANLINES + 1)
    _, light = _light_along(vertices, starts, weights, 0.5 * (edges[1:] + edges[:-1]))
    total = np.concatenate([[0.0], np.cumsum(light[:, -1])])
    y = np.interp(np.linspace(0.0, total[-1], 2 * _BANDS + 1), total, edges)
    x, light = _light_along(vertices, starts, weights, y[1::2])
    # The middle of a band that spans a gap between openings passes nothing: it takes the spans of a neighbour.
    lit = np.flatnonzero(light[:, -1] > 0.0)
    nearest = lit[np.searchsorted(lit, np.arange(_BANDS)).clip(max=len(lit) - 1)]
    return LensTable(np.column_stack([y[:-2:2], y[2::2]]), x[nearest], light[nearest] / light[nearest, -1:])


def light_through(aperture: Aperture) -> float:
    """Weighted area of the outlines in units of the squared pupil radius."""
    return net_area((aperture.outlines, aperture.weights))


def _light_along(
    vertices: Float[np.ndarray, "vertices 2"], starts: Int[np.ndarray, " starts"], weights: Float[np.ndarray, " outlines"], y: np.ndarray
) -> tuple[Float[np.ndarray, "rows edges"], Float[np.ndarray, "rows edges"]]:
    """(x where each line y crosses an outline, sorted; the light passed to the left of there); filled up with the last x."""
    columns = [_crossings(vertices[a:b], y) for a, b in pairwise(starts)]
    steps = [weight * np.where(np.arange(each.shape[1]) % 2, -1.0, 1.0) for each, weight in zip(columns, weights, strict=True)]
    crossings, step = np.concatenate(columns, axis=1), np.broadcast_to(np.concatenate(steps), (len(y), sum(map(len, steps))))
    order = np.argsort(crossings, axis=1, kind="stable")
    x, passed = np.take_along_axis(crossings, order, axis=1), np.cumsum(np.take_along_axis(step, order, axis=1), axis=1)[:, :-1]
    last = np.max(np.where(np.isfinite(x), x, -np.inf), axis=1, keepdims=True)
    x = np.where(np.isfinite(x), x, np.where(np.isfinite(last), last, 0.0))
    widths = np.diff(x, axis=1)
    if np.any((passed < _NEGATIVE) & (widths > 0.0)):
        raise InputError("this aperture takes away more light than it passes at some lens points: a stochastic sampler cannot draw from it")
    return x, np.concatenate([np.zeros((len(y), 1)), np.cumsum(np.maximum(passed, 0.0) * widths, axis=1)], axis=1)


def _crossings(outline: Float[np.ndarray, "vertices 2"], y: Float[np.ndarray, " rows"]) -> Float[np.ndarray, "rows crossings"]:
    """Sorted x at which each line crosses one outline, inf where it crosses less often than the other lines."""
    ends = np.roll(outline, -1, axis=0)
    low, high = np.minimum(outline[:, 1], ends[:, 1]), np.maximum(outline[:, 1], ends[:, 1])
    rows = [np.flatnonzero((y >= a) & (y < b)) for a, b in zip(low, high, strict=True)]
    count = np.zeros(len(y), int)
    for each in rows:
        count[each] += 1
    result, filled = np.full((len(y), max(int(count.max()), 2)), np.inf), np.zeros(len(y), int)
    for (x0, y0), (x1, y1), each in zip(outline, ends, rows, strict=True):
        if len(each):
            result[each, filled[each]] = x0 + (x1 - x0) * (y[each] - y0) / (y1 - y0)
            filled[each] += 1
    return np.sort(result, axis=1)
