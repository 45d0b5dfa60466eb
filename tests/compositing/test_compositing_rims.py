"""Rims of near things in depth that is off by a pixel or two, moved to where photograph and colours show them."""

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
import pytest

from mrbokeh.compositing.between import Between, Rerendered
from mrbokeh.compositing.choose import insertion_of
from mrbokeh.compositing.edge_refinement import EdgeColours, moved
from mrbokeh.compositing.plate import Plate, plate_of
from mrbokeh.images.image_metrics import psnr
from mrbokeh.images.layer import Layer, opaque
from mrbokeh.optics.lens import Lens
from mrbokeh.renderers.polygon.polygon_differences import PolygonDifferences
from tests.support.mixed_reality_cases import MixedCase, small_card_cases, wider

RENDERER = PolygonDifferences()
EXACT_DB, RECOVERED = 0.1, 1.0 / 3.0


def found_db(case: MixedCase, *, refine_edges: bool) -> float:
    return psnr(Between(refine_edges=refine_edges).insert(case.plate, [case.virtual], RENDERER).rgb, case.truth)


def mean_db(cases: Sequence[MixedCase], *, refine_edges: bool) -> float:
    return float(np.mean([found_db(case, refine_edges=refine_edges) for case in cases]))


@pytest.mark.slow
def test_exact_depth_loses_nothing_and_a_pixel_too_wide_costs_less() -> None:
    """Mean of three focus distances. Colours of these cards say little; on the traced sets, which no test can carry, it is two thirds."""
    cards = small_card_cases()
    cases = [case.with_near_wider_by(1) for case in cards]
    exact, kept, mended = mean_db(cards, refine_edges=False), mean_db(cases, refine_edges=False), mean_db(cases, refine_edges=True)
    assert mean_db(cards, refine_edges=True) > exact - EXACT_DB
    assert exact - kept > 3.0  # there is something to win
    assert mended > kept + RECOVERED * (exact - kept)


SIZE, STRIP = (48, 80), np.s_[:, 34:46]
LENS = Lens(100.0, 1.0, 3.0, 36.0)


def strip(by_px: int = 0, noise: float = 0.03) -> tuple[Plate, np.ndarray]:
    """A yellow strip 0.9 m away before a blue wall at 3 m, in focus; the depth of the strip is so many pixels too wide. And where it is."""
    rng = np.random.default_rng(4)
    near = np.zeros(SIZE, bool)
    near[STRIP] = True
    rgb = np.where(near[..., None], [0.6, 0.5, 0.1], [0.1, 0.2, 0.5]) * (1.0 + noise * rng.standard_normal((*SIZE, 1)))
    rgb = rgb.astype(np.float32)
    depth_m = np.where(near, 0.9, 3.0).astype(np.float32)
    seen = RENDERER.render([opaque(rgb, depth_m)], LENS).rgb
    return replace(plate_of(seen, LENS, wider(depth_m, near, by_px)), sharp_rgb=rgb), near


@pytest.mark.parametrize("by_px", [-2, -1, 1, 2])
def test_colours_find_the_rim(by_px: int) -> None:
    plate, near = strip(by_px)
    assert plate.sharp_rgb is not None and plate.depth_m is not None
    wrong = plate.depth_m < 2.0
    assert (wrong != near).sum() == 2 * abs(by_px) * SIZE[0]
    np.testing.assert_array_equal(EdgeColours.of(plate.sharp_rgb, wrong, np.ones(SIZE, bool)).by_colour(), near)


def test_twice_the_light_tells_the_same_on_fishers_line() -> None:
    plate, _ = strip(1, noise=0.3)
    assert plate.sharp_rgb is not None and plate.depth_m is not None
    once, twice = (
        EdgeColours.of(np.float32(factor) * plate.sharp_rgb, plate.depth_m < 2.0, np.ones(SIZE, bool)).nearness for factor in (1.0, 2.0)
    )
    np.testing.assert_allclose(once, twice, atol=1e-4)
    # The compiled loop against NumPy at one pixel.
    assert plate.sharp_rgb is not None and plate.depth_m is not None
    rims = EdgeColours.of(plate.sharp_rgb, plate.depth_m < 2.0, np.ones(SIZE, bool))
    y, x = 20, 33
    window = np.s_[y - 5 : y + 6, x - 5 : x + 6]
    sure, near = ~rims.unsure[window] & ~rims.lit[window], rims.near[window]
    level = plate.sharp_rgb[window][sure].mean(dtype=np.float64)
    values = plate.sharp_rgb[window].astype(np.float64)
    values = values / (values + level)
    sides = [values[sure & each] for each in (near, ~near)]
    means = [each.mean(axis=0) for each in sides]
    spread = np.mean([np.cov(each.T, bias=True) for each in sides], axis=0) + 6e-5 * np.eye(3)
    line = np.linalg.solve(spread, means[0] - means[1])
    expected = (values[5, 5] - means[1]) @ line / ((means[0] - means[1]) @ line)
    assert rims.nearness[y, x] == pytest.approx(expected, abs=1e-3)


def test_lights_at_a_rim_may_be_far_and_a_thin_wire_keeps_its_middle() -> None:
    plate, near = strip(1)
    assert plate.sharp_rgb is not None and plate.depth_m is not None
    rgb = plate.sharp_rgb.copy()
    rgb[20, 33], rgb[30, 48] = 50.0, 50.0
    told = EdgeColours.of(rgb, plate.depth_m < 2.0, np.ones(SIZE, bool)).by_colour()
    assert not told[20, 33] and not told[30, 48] and near[20, 34]
    # Grey on grey, where colours do not tell: the proposal takes a rim of a broad thing, but never all of a thin one.
    near = np.zeros((30, 60), bool)
    near[:, 10:12], near[:, 30:45] = True, True
    told = EdgeColours.of(np.full((30, 60, 3), 0.3, np.float32), near, np.ones_like(near))
    assert np.isnan(told.nearness).all() and (told.by_colour() == near).all()
    left = told.without_rim()
    assert left[2:-2, 10:12].any(axis=1).all() and left[15].sum() < near[15].sum()
    depth_m = np.array([[1.0, 1.1, 3.0, 3.2, 3.4]], np.float32)
    near = depth_m < 2.0
    np.testing.assert_allclose(moved(depth_m, near, np.array([[True, True, True, False, False]])), [[1.0, 1.1, 1.1, 3.2, 3.4]])
    np.testing.assert_allclose(moved(depth_m, near, np.array([[True, False, False, False, False]])), [[1.0, 3.0, 3.0, 3.2, 3.4]])


def virtual_wall() -> Layer:
    return opaque(np.full((*SIZE, 3), 0.9, np.float32), np.full(SIZE, 1.6, np.float32))


@pytest.mark.parametrize("by_px", [-2, -1, 1, 2])
@pytest.mark.parametrize("make", [Between, Rerendered])
def test_both_modes_that_cut_the_scene_use_it(make: Callable[..., Between | Rerendered], by_px: int) -> None:
    """Against the picture by exact depth, with depth too wide or too narrow."""
    exact, wrong = (make(refine_edges=False).insert(strip(each)[0], [virtual_wall()], RENDERER).rgb for each in (0, by_px))
    mended = make(refine_edges=True).insert(strip(by_px)[0], [virtual_wall()], RENDERER).rgb
    assert np.abs(mended - exact).mean() < 0.2 * np.abs(wrong - exact).mean()


@pytest.mark.parametrize("mode", ["between", "rerender"])
def test_it_can_be_switched_off(mode: str) -> None:
    plate, _ = strip(1)
    trusted, mended = (insertion_of(mode, exact_depth=exact).insert(plate, [virtual_wall()], RENDERER).rgb for exact in (True, False))
    assert np.abs(trusted - mended).max() > 0.05


def test_large_pictures_are_compared_at_half_their_size_and_a_users_matte_stays(monkeypatch: pytest.MonkeyPatch) -> None:
    strips = ((0, False), (2, False), (2, True))  # how many pixels too wide, and whether rims are looked for
    exact, wrong, mended = (Between(refine_edges=rims).insert(strip(by_px)[0], [virtual_wall()], RENDERER).rgb for by_px, rims in strips)
    monkeypatch.setattr("mrbokeh.compositing.edge_refinement._LARGE_PX", 100)
    halved = Between().insert(strip(2)[0], [virtual_wall()], RENDERER).rgb
    assert not np.array_equal(halved, mended)  # it is another comparison
    assert np.abs(halved - exact).mean() < 0.5 * np.abs(wrong - exact).mean()
    plate, near = strip(1)
    matted = replace(plate, near_alpha=near.astype(np.float32))
    trusted, asked = (Between(refine_edges=rims).insert(matted, [virtual_wall()], RENDERER).rgb for rims in (False, True))
    np.testing.assert_array_equal(trusted, asked)
