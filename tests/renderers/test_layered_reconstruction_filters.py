"""Layered reconstruction: its filters over the screen against their definitions and slow twins."""

import math
from itertools import pairwise

import numpy as np
import pytest
from scipy.special import erf

from mrbokeh.optics.aperture import Aperture
from mrbokeh.renderers.layered_reconstruction import footprint_sigmas
from mrbokeh.renderers.layered_reconstruction._filter_numba import axes
from mrbokeh.renderers.layered_reconstruction._gaussians_numba import direct_gaussian, recursive_rows, sheared_gaussian, texture_gaussian
from mrbokeh.renderers.layered_reconstruction._tile_data import STRIPS, packed_pupil, pupil_spans
from mrbokeh.renderers.layered_reconstruction._windows_numba import along_line, line_taps, pupil_filter, sums_along_x, window_guards


def test_constants_are_the_papers() -> None:
    """Eq. 3; the paper rounds it to 2.24."""
    alpha = footprint_sigmas(0.95)
    assert alpha == pytest.approx(2.236, abs=5e-4)
    assert erf(alpha / np.sqrt(2.0)) ** 2 == pytest.approx(0.95, abs=1e-12)
    # Eq. 10: gamma = exp(-sqrt(2) / sigma); 1 % away at 10 px, and exact in variance at any width (the test above).
    from mrbokeh.renderers.layered_reconstruction._gaussians_numba import feedback

    assert feedback(100.0) == pytest.approx(math.exp(-math.sqrt(2.0) / 10.0), rel=1e-3)


def impulse(size_px: int) -> np.ndarray:
    planes = np.zeros((size_px, size_px, 1), np.float32)
    planes[size_px // 2, size_px // 2] = 1.0
    return planes


def moments(kernel: np.ndarray) -> tuple[float, float, float, float]:
    """Sum and second moments xx, xy, yy about the middle."""
    kernel = kernel[..., 0].astype(np.float64)
    y, x = np.indices(kernel.shape) - (np.array(kernel.shape)[:, None, None] // 2)
    return kernel.sum(), *(float((kernel * each).sum() / kernel.sum()) for each in (x * x, x * y, y * y))


@pytest.mark.parametrize("variance_px2", [0.3, 1.0, 9.0, 100.0])
@pytest.mark.parametrize("passes", [1, 2, 3])
def test_the_recursive_filter_keeps_light_and_has_the_variance_asked_for(variance_px2: float, passes: int) -> None:
    row = np.zeros((1, 401, 1), np.float32)
    row[0, 200] = 1.0
    recursive_rows(row, variance_px2, passes)
    at = np.arange(401) - 200
    assert row.sum() == pytest.approx(1.0, rel=1e-4)
    assert (row[0, :, 0].astype(np.float64) * at**2).sum() == pytest.approx(variance_px2, rel=1e-3)
    np.testing.assert_allclose(row[0, :, 0], row[0, ::-1, 0], atol=1e-7)


COVARIANCES = [(9.0, 0.0, 9.0), (25.0, 0.0, 2.0), (12.0, 8.0, 9.0), (2.0, -1.5, 16.0)]


@pytest.mark.parametrize("v", COVARIANCES)
def test_the_sheared_filter_is_the_direct_gaussian(v: tuple[float, float, float]) -> None:
    """Second moments within 4 % (the guard band cuts both), and the shape the nearer, the more passes."""
    guard, size = 18, 37
    direct, errors = np.empty((size, size, 1), np.float32), []
    direct_gaussian(direct, impulse(size + 2 * guard), guard, guard, *v)
    for passes in (1, 3):
        out = np.empty_like(direct)
        sheared_gaussian(out, impulse(size + 2 * guard), guard, guard, *v, passes)
        errors.append(float(np.abs(out - direct).sum()))
        if passes == 3:
            np.testing.assert_allclose(moments(out), moments(direct), rtol=0.04, atol=0.05)
    assert errors[1] < 0.6 * errors[0] and errors[1] < 0.2, "share of the light that lies elsewhere"


@pytest.mark.parametrize("v", COVARIANCES)
def test_four_look_ups_come_nearer_to_the_gaussian_than_one(v: tuple[float, float, float]) -> None:
    """Averaged over where the texels of the mip map lie, for a look-up is not the same everywhere."""
    guard, size = 24, 49
    direct = np.empty((size, size, 1), np.float32)
    direct_gaussian(direct, impulse(size + 2 * guard), guard, guard, *v)
    errors = {}
    for taps in (1, 4):
        mean = np.zeros((size, size))
        for shift in np.ndindex(4, 4):
            planes = np.roll(impulse(size + 2 * guard), shift, (0, 1))
            out = np.empty_like(direct)
            texture_gaussian(out, planes, guard, guard, *axes(*v), footprint_sigmas(0.95), 0.33, taps)
            mean += np.roll(out[..., 0], (-shift[0], -shift[1]), (0, 1)) / 16.0
        errors[taps] = float(np.abs(mean - direct[..., 0]).sum())
        assert mean.sum() == pytest.approx(1.0, abs=0.02)
    assert errors[4] < errors[1] if v[0] == v[2] else errors[4] < 0.6
    assert errors[4] < 0.6


@pytest.mark.slow
@pytest.mark.parametrize("v", [(9.0, 0.0, 9.0), (60.0, 0.0, 4.0)])
def test_a_look_up_is_as_wide_along_both_axes(v: tuple[float, float, float]) -> None:
    """A box of the width w = alpha sigma and the tent of the interpolation have w^2/4 = 1.25 sigma^2; trilinear blends of two
    levels more, by the ratio of their widths. Four look-ups are scaled to sigma^2."""
    guard, size, alpha = 40, 81, footprint_sigmas(0.95)
    for taps, expected in ((1, alpha**2 / 4), (4, 1.0)):
        mean = np.zeros((size, size, 1))
        for shift in np.ndindex(8, 8):
            out = np.empty((size, size, 1), np.float32)
            texture_gaussian(out, np.roll(impulse(size + 2 * guard), shift, (0, 1)), guard, guard, *axes(*v), alpha, 0.33, taps)
            mean += np.roll(out, (-shift[0], -shift[1]), (0, 1)) / 64.0
        total, along, _, across = moments(mean)
        assert total == pytest.approx(1.0, abs=0.02)
        assert along / v[0] == pytest.approx(expected, rel=0.2) and across / v[2] == pytest.approx(expected, rel=0.25)


WHOLE = (-0.5, 0.5)


def filtered(planes: np.ndarray, spans: np.ndarray, scale: float, length: tuple[float, float], guards: tuple, when: tuple) -> np.ndarray:
    """Pupil, then a stretch of the shutter."""
    side = planes.shape[0] - 2 * (guards[1] + guards[2]), planes.shape[1] - 2 * (guards[0] + guards[2])
    blurred = np.empty((side[0] + 2 * guards[1], side[1] + 2 * guards[0], 1), np.float32)
    pupil_filter(blurred, planes, sums_along_x(planes), spans, scale, guards[2])
    out = np.empty((*side, 1), np.float32)
    along_line(out, blurred, *line_taps(-length[0], -length[1], *when), guards[0], guards[1])
    return out


@pytest.mark.slow
@pytest.mark.parametrize(("scale", "length"), [(-5.3, (7.0, 3.0)), (1.7, (-4.0, 11.5)), (9.0, (0.0, 0.0))])
@pytest.mark.parametrize(("across", "cell", "when"), [(1, 0, WHOLE), (2, 1, (-0.5, -0.25)), (2, 2, (0.25, 0.5)), (3, 4, (0.0, 0.5))])
def test_the_window_filter_is_chance_through_a_part_of_pupil_and_shutter(
    scale: float, length: tuple[float, float], across: int, cell: int, when: tuple[float, float]
) -> None:
    """Its slow twin: 400 000 places in (a cell of) a heart-shaped pupil and (a stretch of) the shutter, and which pixel each reads.

    A pixel at x reads around x - scale u - length t, so an impulse comes out at + scale u + length t.
    """
    rng, heart = np.random.default_rng(1), Aperture.heart()
    spans, starts, shares = packed_pupil(heart, across)
    finest = starts[(len(STRIPS) - 1) * len(shares) + cell :][:2]
    spans = spans[finest[0] : finest[1]]
    guards = window_guards(scale, heart.unit_radius, *length, 0.0)
    guard_x, guard_y = guards[0] + guards[2], guards[1] + guards[2]
    planes = np.zeros((41 + 2 * guard_y, 41 + 2 * guard_x, 1), np.float32)
    planes[20 + guard_y, 20 + guard_x] = 1.0
    out = filtered(planes, spans, scale, length, guards, when)
    chosen = spans[rng.choice(len(spans), 400_000, p=spans[:, 3])]
    u = chosen[:, 1] + rng.uniform(size=400_000) * (chosen[:, 2] - chosen[:, 1])
    v = chosen[:, 0] + (rng.uniform(size=400_000) - 0.5) * chosen[:, 4]
    t = rng.uniform(*when, 400_000)
    off_x = np.floor(0.5 + scale * u) + np.floor(0.5 + length[0] * t)
    off_y = np.floor(0.5 + scale * v) + np.floor(0.5 + length[1] * t)
    thrown, _, _ = np.histogram2d(off_y, off_x, bins=np.arange(-20.5, 21.0))
    assert np.abs(out[..., 0] - thrown / thrown.sum()).sum() < 0.03, "what chance over two hundred pixels leaves"
    assert out.sum() == pytest.approx(1.0, abs=1e-4)


def test_segments_are_shared_out_by_length_and_running_sums_forget_a_lamp() -> None:
    """Of a segment of 3 px along x one third lies in each of three pixels; of one of 2 px half in the middle, a quarter beside."""
    for length, expected in ((3.0, [1 / 3, 1 / 3, 1 / 3]), (2.0, [0.25, 0.5, 0.25]), (0.0, [1.0])):
        offsets, weights = line_taps(length, 0.0, *WHOLE)
        np.testing.assert_allclose(weights, expected, atol=1e-6)
        np.testing.assert_array_equal(offsets[:, 0], np.arange(len(expected)) - len(expected) // 2)
    offsets, weights = line_taps(4.0, 0.0, 0.0, 0.25)
    assert offsets[:, 0].tolist() == [0, 1] and weights.tolist() == [0.5, 0.5], "from 0 to 1 px: half in each of two pixels"
    # Steps of single precision at 1e5 are 0.008, eight times the light beside the lamp: running sums must be kept in double.
    planes = np.full((21, 101, 1), 1e-3, np.float32)
    planes[:, 10] = 1e5
    out = np.empty((1, 81, 1), np.float32)
    pupil_filter(out, planes, sums_along_x(planes), pupil_spans(Aperture.disc(), 8), 5.0, 10)
    np.testing.assert_allclose(out[0, 20:], 1e-3, rtol=1e-5)


@pytest.mark.parametrize("aperture", [Aperture.disc(), Aperture.heart(), Aperture.ring(0.5)])
@pytest.mark.parametrize("across", [2, 3])
def test_cells_of_the_pupil_make_up_the_whole(aperture: Aperture, across: int) -> None:
    """Each sums to 1, and by their shares they have the mean and the second moment of the whole opening."""
    spans, starts, shares = packed_pupil(aperture, across)
    whole = packed_pupil(aperture)[0][-len(pupil_spans(aperture, STRIPS[-1])) :]
    assert shares.sum() == pytest.approx(1.0) and (shares > 0).all() and len(shares) <= across**2
    assert len(starts) == 2 * len(STRIPS) * len(shares) + 1
    cells = [spans[a:b] for a, b in pairwise(starts)]
    assert all(cell[:, 3].sum() == pytest.approx(1.0) for cell in cells)
    for power in (1, 2):
        parts = np.array([_moments(cell, power) for cell in cells[-len(shares) :]])
        np.testing.assert_allclose(shares @ parts, _moments(whole, power), atol=1e-6)


def _moments(spans: np.ndarray, power: int) -> tuple[float, float]:
    """Means of u and of v to the power 1 or 2 over strips."""
    v, from_u, to_u, weight, height = spans.T
    mean_u, mean_v = 0.5 * (from_u + to_u), v
    if power == 1:
        return float(weight @ mean_u), float(weight @ mean_v)
    return float(weight @ (mean_u**2 + (to_u - from_u) ** 2 / 12)), float(weight @ (mean_v**2 + height**2 / 12))
