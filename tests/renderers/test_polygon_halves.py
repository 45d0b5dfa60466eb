"""Polygonal differences at half the resolution: what is far out of focus, against the same at full resolution and a plain twin."""

from itertools import product

import numpy as np
import pytest

from mrbokeh.images.image_metrics import psnr
from mrbokeh.optics.aperture import Aperture
from mrbokeh.renderers.polygon.polygon_differences import PolygonDifferences
from tests.renderers.test_polygon_differences import picture, plain_scatter

OCTAGON, HEART = Aperture.blades(8, np.pi / 8), Aperture.heart()
FULL = PolygonDifferences(halve_from_px=np.inf, exact_highlights=False, precision="double")
RENDERER = PolygonDifferences(halve_from_px=64.0)
HALVED = PolygonDifferences(halve_from_px=64.0, exact_highlights=False, precision="double")


def hills(height: int, width: int, low_px: float, high_px: float) -> np.ndarray:
    y, x = np.mgrid[:height, :width]
    return (low_px + (high_px - low_px) * (0.5 + 0.5 * np.sin(x / 60.0) * np.cos(y / 45.0))).astype(np.float32)


def shares(pixel: int) -> list[tuple[int, float]]:
    """The two cells that a pixel belongs to along one direction, cells being two pixels wide and the first before the picture."""
    own = pixel // 2 + 1
    return [(own, 0.75), (own - 1 if pixel % 2 == 0 else own + 1, 0.25)]


def plainly_halved(values: np.ndarray, diameter_px: float, name: str) -> np.ndarray:
    """Every pixel of one diameter to four cells, cells as pixels of half the diameter, and every pixel from four cells."""
    height, width, channels = values.shape
    half, result = np.zeros((height // 2 + 2, width // 2 + 2, channels), np.float64), np.zeros(values.shape)
    for y, x in np.ndindex(height, width):
        for (row, down), (column, across) in product(shares(y), shares(x)):
            half[row, column] += down * across * values[y, x]
    spread = plain_scatter(half.astype(np.float32), np.full(half.shape[:2], 0.5 * diameter_px, np.float32), name)
    for y, x in np.ndindex(height, width):
        result[y, x] = sum(0.25 * down * across * spread[row, column] for (row, down), (column, across) in product(shares(y), shares(x)))
    return result


@pytest.mark.parametrize(("name", "diameter_px"), [("octagon", 73.0), ("heart", -80.4)])
def test_the_plain_twin_agrees(name: str, diameter_px: float) -> None:
    values = picture(12, 16)
    aperture = {"octagon": OCTAGON, "heart": HEART}[name]
    expected = plainly_halved(values, diameter_px, name)
    reached = HALVED.sum_kernels(values, np.full((12, 16), diameter_px, np.float32), aperture)
    np.testing.assert_allclose(reached, np.maximum(expected, 0.0), atol=3e-7 * expected.max())


@pytest.mark.parametrize("aperture", [OCTAGON, HEART])
def test_a_texture_looks_as_at_full_resolution(aperture: Aperture) -> None:
    """Noise in [0, 1] under 20 to 220 px. From 64 px on kernels are 32 cells and wider; their rims, softened by about a cell, are all
    that differs: as much as rectified kernels are off anyway."""
    values, coc_px = picture(360, 420), hills(360, 420, 20.0, 220.0)
    full, halved = FULL.sum_kernels(values, coc_px, aperture), HALVED.sum_kernels(values, coc_px, aperture)
    assert psnr(halved, full) > 59.0
    assert np.abs(halved.sum() / full.sum() - 1.0) < 1e-3  # rims lie elsewhere beyond the frame


@pytest.mark.parametrize("place", [(150, 150), (151, 150), (150, 151), (151, 151)])
@pytest.mark.parametrize("diameter_px", [75.0, 150.0])
def test_light_stays_in_place_on_odd_and_even_pixels(place: tuple[int, int], diameter_px: float) -> None:
    """A point that is no highlight: all of its light, and the centre of it, which half a cell would move by 0.5 px or more."""
    values = np.zeros((300, 300, 1), np.float32)
    values[place] = 1.0
    spread = HALVED.sum_kernels(values, np.full((300, 300), diameter_px, np.float32), OCTAGON)[..., 0].astype(np.float64)
    y, x = np.mgrid[:300, :300]
    assert spread.sum() == pytest.approx(1.0, abs=1e-5)
    assert ((spread * y).sum(), (spread * x).sum()) == pytest.approx(place, abs=2e-3)


@pytest.mark.parametrize("diameter_px", [65.0, 70.0, 90.0, -230.0])
def test_an_even_field_stays_even(diameter_px: float) -> None:
    """Look farther from the border than the largest kernel reaches."""
    values, coc_px = np.full((301, 313, 4), 0.7, np.float32), np.full((301, 313), diameter_px, np.float32)
    np.testing.assert_allclose(HALVED.sum_kernels(values, coc_px, OCTAGON)[130:-130, 130:-130], 0.7, rtol=1e-5)


def test_edges_of_depth_are_not_halved_and_diameters_without_light_do_not_matter() -> None:
    """Beside a large step of diameters kernels stay as they are, bit for bit in what each pixel throws."""
    values, coc_px = picture(120, 300), np.full((120, 300), 4.0, np.float32)
    coc_px[:, 150:] = 80.0
    values[:, 158:] = 0.0
    values[:, :142] = 0.0
    coc_px[:, 148:152] = np.linspace(4.0, 80.0, 4)
    values[:, 142:147] = values[:, 153:158] = 0.0
    np.testing.assert_allclose(HALVED.sum_kernels(values, coc_px, OCTAGON), FULL.sum_kernels(values, coc_px, OCTAGON), atol=1e-8)
    values, even = picture(160, 200), np.full((160, 200), 80.0, np.float32)
    values[:, 90:110] = 0.0
    values[::7, ::5] = 0.0
    wild = even.copy()
    empty = ~values.any(axis=2)
    wild[empty] = np.random.default_rng(3).uniform(-500.0, 500.0, int(empty.sum()))
    np.testing.assert_allclose(HALVED.sum_kernels(values, wild, OCTAGON), HALVED.sum_kernels(values, even, OCTAGON), rtol=1e-5, atol=1e-8)


def test_highlights_are_spread_whole_and_threads_do_not_change_a_bit() -> None:
    values, coc_px = np.full((300, 300, 4), 1e-3, np.float32), np.full((300, 300), 100.0, np.float32)
    values[150, 151] = 50.0
    lamp = RENDERER.sum_kernels(values, coc_px, OCTAGON) - RENDERER.sum_kernels(np.full_like(values, 1e-3), coc_px, OCTAGON)
    kernel = 49.999 * OCTAGON.rasterize(100.0).kernel
    reach = kernel.shape[0] // 2
    seen = lamp[150 - reach : 151 + reach, 151 - reach : 152 + reach, 0]
    np.testing.assert_allclose(seen, kernel, atol=2e-3 * kernel.max())
    # Above 1 << 18 pixels there are two bands, and threads for them.
    values, coc_px = picture(640, 700), hills(640, 700, 10.0, 150.0)
    one, three = (PolygonDifferences(halve_from_px=64.0, threads=threads).sum_kernels(values, coc_px, OCTAGON) for threads in (1, 3))
    np.testing.assert_array_equal(one, three)
