"""Depth noise of a film: what it does to the composite, and that filtering the depth calms it without lag."""

from itertools import pairwise

import numpy as np
import pytest

from mrbokeh.compositing.over import OverPhotograph
from mrbokeh.compositing.plate import plate_of
from mrbokeh.depth.depth_filters import TemporalDepthFilter
from mrbokeh.images.layer import Layer
from mrbokeh.optics.lens import Lens
from mrbokeh.renderers.polygon.polygon_differences import PolygonDifferences
from tests.support.refusals import refused

SIZE = (80, 128)
LENS = Lens(50.0, 2.0, 1.5, 10.0)
NOISE = 0.01
WARM_UP = 3


def photographed_scene() -> tuple[np.ndarray, np.ndarray]:
    """A floor that recedes from 1 m to 3 m, with a post at 1.2 m before it, and its picture."""
    rng = np.random.default_rng(2)
    dioptres = np.broadcast_to(np.linspace(1.0 / 3.0, 1.0, SIZE[0])[:, None], SIZE).copy()
    dioptres[:, 50:62] = 1.0 / 1.2
    rgb = np.kron(rng.uniform(0.05, 0.8, (SIZE[0] // 4, SIZE[1] // 4, 3)), np.ones((4, 4, 1)))
    return rgb.astype(np.float32), (1.0 / dioptres).astype(np.float32)


def virtual_carpet() -> Layer:
    """A bright disc that lies in the floor, behind the post: 4 % deeper than the floor, where the matte is half open."""
    y, x = np.mgrid[: SIZE[0], : SIZE[1]]
    alpha = (np.hypot(x - 64, y - 42) < 28).astype(np.float32)
    rgb = alpha[..., None] * np.array([0.9, 0.7, 0.2], np.float32)
    floor_m = 1.0 / np.broadcast_to(np.linspace(1.0 / 3.0, 1.0, SIZE[0])[:, None], SIZE)
    return Layer(rgb, alpha, np.where(alpha > 0, 1.04 * floor_m, np.inf).astype(np.float32))


def mean_change(depths: list[np.ndarray]) -> float:
    """Mean absolute difference of consecutive composites of the same still photograph."""
    rgb, _ = photographed_scene()
    way, renderer = OverPhotograph(), PolygonDifferences(threads=1)
    frames = [way.insert(plate_of(rgb, LENS, depth_m), [virtual_carpet()], renderer).rgb for depth_m in depths]
    return float(np.mean([np.abs(b - a).mean() for a, b in pairwise(frames)]))


def test_noise_of_depth_does_not_flicker_in_the_composite() -> None:
    """1 % depth noise must change consecutive pictures by less than 0.2 % of white on average: the number of the task."""
    _, true_m = photographed_scene()
    rng = np.random.default_rng(3)
    noisy = [(true_m * (1.0 + NOISE * rng.standard_normal(SIZE))).astype(np.float32) for _ in range(10)]
    steady = TemporalDepthFilter()
    filtered = [steady.filtered(each) for each in noisy]
    before, after = mean_change(noisy[WARM_UP:]), mean_change(filtered[WARM_UP:])
    assert after < 0.002 < before
    assert after < before / 5.0


def test_noise_falls_as_that_of_a_mean_and_is_measured() -> None:
    """The mean of n frames has 1/sqrt(n) of their noise; the filter measures what it was fed."""
    _, true_m = photographed_scene()
    rng = np.random.default_rng(4)
    steady = TemporalDepthFilter(memory=16)
    for _ in range(16):
        result = steady.filtered((true_m * (1.0 + NOISE * rng.standard_normal(SIZE))).astype(np.float32))
    error = result / true_m - 1.0
    assert float(error.std()) == pytest.approx(NOISE / 4.0, rel=0.1)
    assert abs(float(error.mean())) < 2e-4
    assert steady.noise == pytest.approx(NOISE, rel=0.1)


def moving_card(step: int, noise: float, rng: np.random.Generator) -> np.ndarray:
    depth_m = np.full(SIZE, 3.0)
    depth_m[20:60, 10 + 5 * step : 40 + 5 * step] = 1.0
    return (depth_m * (1.0 + noise * rng.standard_normal(SIZE))).astype(np.float32)


def test_a_moving_edge_does_not_lag() -> None:
    """In every frame the card is where it is, not where it was: no pixel is nearer to the other surface than to its own."""
    rng, steady = np.random.default_rng(5), TemporalDepthFilter()
    for step in range(12):
        found = 1.0 / steady.filtered(moving_card(step, NOISE, rng))
        true = 1.0 / moving_card(step, 0.0, rng)
        assert float((np.abs(found - true) > 0.1 * (1.0 - 1.0 / 3.0)).mean()) < 2e-4


def test_a_wire_is_there_at_once_and_a_slow_approach_does_not_lag() -> None:
    rng, steady = np.random.default_rng(7), TemporalDepthFilter()
    for step in range(8):
        depth_m = np.full(SIZE, 2.0)
        if step >= 5:
            depth_m[:, 30] = 1.0
        found = steady.filtered((depth_m * (1.0 + NOISE * rng.standard_normal(SIZE))).astype(np.float32))
    assert np.abs(found[1:-1, 30] - 1.0).max() < 0.06
    # A wall that comes nearer by 0.6 % a frame, below the noise of a pixel: the whole neighbourhood tells.
    rng, steady = np.random.default_rng(6), TemporalDepthFilter()
    errors = []
    for step in range(20):
        true_m = 2.0 * 0.994**step
        still = np.full(SIZE, 3.0)
        still[20:60, 20:70] = true_m
        found = steady.filtered((still * (1.0 + NOISE * rng.standard_normal(SIZE))).astype(np.float32))
        errors.append(float(found[25:55, 25:65].mean() / true_m - 1.0))
    assert max(map(abs, errors[4:])) < 0.006


def test_infinity_stays_and_another_size_is_refused() -> None:
    depth_m = np.full(SIZE, np.inf, np.float32)
    depth_m[:40] = 2.0
    steady = TemporalDepthFilter()
    for _ in range(3):
        np.testing.assert_array_equal(steady.filtered(depth_m), depth_m)
    refused("keep its size", steady.filtered, np.ones((6, 4), np.float32))
    refused("memory", TemporalDepthFilter, memory=0)
