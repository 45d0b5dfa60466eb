"""Depth mended by the picture: what is exact stays, what is not goes where the picture has it."""

from collections.abc import Callable

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter, grey_dilation, grey_erosion

import mrbokeh
from mrbokeh.depth.edge_votes import Guide, narrowed
from mrbokeh.depth.mended_depth import filled, mended
from mrbokeh.depth.soft_edges import softness
from mrbokeh.system.errors import InputError

NEAR_M, FAR_M = np.float32(1.0), np.float32(4.0)
GREEN, RED = (0.1, 0.5, 0.2), (0.5, 0.15, 0.1)
SIZE = (90, 120)
NOISE = 0.02
HALF_OF_THE_JUMP = 0.5 * (1.0 / NEAR_M - 1.0 / FAR_M)


def board(near: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return depth and picture: what is near is red, the rest green, both a little uneven."""
    rng = np.random.default_rng(0)
    rgb = np.where(near[..., None], RED, GREEN) + rng.normal(0.0, NOISE, (*near.shape, 3))
    return np.where(near, NEAR_M, FAR_M), np.clip(rgb, 0.0, 1.0).astype(np.float32)


def block() -> np.ndarray:
    near = np.zeros(SIZE, bool)
    near[20:70, 30:80] = True
    return near


def blurred(depth_m: np.ndarray, sigma_px: float) -> np.ndarray:
    """Return depth as a network gives it: soft in dioptres."""
    return (1.0 / gaussian_filter(1.0 / depth_m, sigma_px)).astype(np.float32)


def wrong(depth_m: np.ndarray, near: np.ndarray) -> int:
    """Count the pixels nearer to the other surface's dioptres."""
    return int(np.count_nonzero((1.0 / depth_m > 1.0 / FAR_M + HALF_OF_THE_JUMP) != near))


def test_exact_depth_stays_to_the_bit() -> None:
    depth_m, rgb = board(block())
    found = mended(depth_m, rgb)
    assert found.told == ""
    assert np.array_equal(found.depth_m, depth_m)


@pytest.mark.parametrize("far_m", [FAR_M, np.float32(np.inf)])
def test_a_small_thing_alone_in_front_stays_near(far_m: np.float32) -> None:
    """It is less than a hundredth of the picture: what is usual there says nothing of it. Open sky lies behind, or a wall."""
    near = np.zeros(SIZE, bool)
    near[40:47, 50:57] = True
    depth_m, rgb = board(near)
    dioptres = np.where(near, 1.0 / NEAR_M, 1.0 / far_m)
    soft = gaussian_filter(dioptres, 1.5).astype(np.float32)
    depth_m = np.full(SIZE, np.inf, np.float32)
    np.divide(np.float32(1.0), soft, out=depth_m, where=soft > 1e-4)
    found = mended(depth_m, rgb)
    assert found.depth_m[43, 53] <= depth_m[43, 53] * 1.01


@pytest.mark.parametrize("is_even_in_metres", [False, True])
def test_a_slanted_surface_stays_to_the_bit(is_even_in_metres: bool) -> None:
    rows, _ = np.mgrid[: SIZE[0], : SIZE[1]]
    depth_m = (1.0 + 0.03 * rows if is_even_in_metres else 1.0 / (0.2 + 0.01 * rows)).astype(np.float32)
    _, rgb = board(block())
    assert np.array_equal(mended(depth_m, rgb).depth_m, depth_m)


@pytest.mark.parametrize("sigma_px", [1.0, 2.0, 3.0])
def test_edges_tell_how_soft_they_are(sigma_px: float) -> None:
    depth_m, _ = board(block())
    found = softness((1.0 / blurred(depth_m, sigma_px)).astype(np.float32), 0.02)
    assert found.sigma_px == pytest.approx(sigma_px, rel=0.05)


@pytest.mark.parametrize("sigma_px", [1.5, 2.0, 3.0])
def test_a_soft_step_becomes_a_hard_one_at_the_edge_of_the_picture(sigma_px: float) -> None:
    near = block()
    depth_m, rgb = board(near)
    found = mended(blurred(depth_m, sigma_px), rgb).depth_m
    assert wrong(found, near) <= 4, "the corners at most"
    off = np.minimum(np.abs(1.0 / found - 1.0 / NEAR_M), np.abs(1.0 / found - 1.0 / FAR_M))
    assert np.count_nonzero(off > 0.2 * HALF_OF_THE_JUMP) <= 8, "a ramp has hundreds of pixels between the surfaces"


def test_soft_metres_are_mended_as_well_as_soft_dioptres() -> None:
    near = block()
    depth_m, rgb = board(near)
    assert wrong(mended(gaussian_filter(depth_m, 2.0), rgb).depth_m, near) <= 4


def test_a_thin_wire_is_kept_and_as_near_as_it_was() -> None:
    near = block()
    near[:, 100:103] = True
    depth_m, rgb = board(near)
    soft_m = blurred(depth_m, 2.0)
    wire = np.s_[10:-10, 101]
    assert np.median(soft_m[wire]) > 1.4 * NEAR_M, "blurred, it lies too far away"
    assert np.median(mended(soft_m, rgb).depth_m[wire]) == pytest.approx(NEAR_M, rel=0.1)


@pytest.mark.parametrize("damage", [grey_erosion, grey_dilation])
def test_edges_a_pixel_off_are_moved_to_those_of_the_picture(damage: Callable[..., np.ndarray]) -> None:
    near = block()
    depth_m, rgb = board(near)
    off_m = damage(depth_m, (3, 3))
    assert wrong(off_m, near) > 150, "a pixel all around"
    assert wrong(mended(off_m, rgb).depth_m, near) <= 10


@pytest.mark.parametrize("width_px", [4, 50])
def test_what_is_far_too_wide_is_as_wide_as_its_colour(width_px: int) -> None:
    """Depth from focus takes what lies up to 7 px beside a near thing for it; a thing thinner than that is found by its middle."""
    near = np.zeros(SIZE, bool)
    near[20:70, 40 : 40 + width_px] = True
    depth_m, rgb = board(near)
    wide = (1.0 / grey_erosion(depth_m, (15, 15))).astype(np.float32)
    now = narrowed(wide, Guide.of(rgb), float(HALF_OF_THE_JUMP), np.ones(SIZE, bool), 8)
    assert wrong(1.0 / wide, near) > 750
    assert wrong(1.0 / now, near) <= 40
    grey = np.repeat(rgb.mean(axis=(0, 1), keepdims=True).mean(axis=2, keepdims=True), 3, axis=2) * np.ones((*SIZE, 1), np.float32)
    np.testing.assert_array_equal(narrowed(wide, Guide.of(grey), float(HALF_OF_THE_JUMP), np.ones(SIZE, bool), 8), wide)


def test_holes_take_the_surface_whose_colour_they_have() -> None:
    near = block()
    depth_m, rgb = board(near)
    holes_m = depth_m.copy()
    holes_m[40:50, 60:100] = np.nan  # across the edge of the near thing, at column 80
    holes_m[5:9, 5:9] = 0.0
    found = mended(holes_m, rgb).depth_m
    assert wrong(found, near) <= 10
    assert np.array_equal(found[~np.isnan(holes_m) & (holes_m > 0)], depth_m[~np.isnan(holes_m) & (holes_m > 0)])


def test_holes_are_reached_on_the_cheapest_way() -> None:
    """Against a plain search over all ways (Bellman and Ford): equal costs, so each hole has a value that is reached at least cost."""
    rng = np.random.default_rng(3)
    rgb, depth_m = rng.uniform(0.0, 0.5, (12, 14, 3)).astype(np.float32), rng.uniform(1.0, 2.0, (12, 14)).astype(np.float32)
    known = rng.uniform(size=depth_m.shape) < 0.15
    guide = Guide.of(rgb)
    found = filled(depth_m, known, guide)
    cost, values = np.where(known, 0, 10**6), [[{float(depth_m[y, x])} if known[y, x] else set() for x in range(14)] for y in range(12)]
    for _ in range(60):
        for y in range(12):
            for x in range(14):
                for v, u in ((y - 1, x), (y + 1, x), (y, x - 1), (y, x + 1)):
                    if not known[y, x] and 0 <= v < 12 and 0 <= u < 14:
                        away = float(np.sqrt(((guide.root[v, u] - guide.root[y, x]) ** 2).sum(dtype=np.float32)))
                        there = cost[v, u] + 1 + int(60.0 * away)
                        if there < cost[y, x]:
                            cost[y, x], values[y][x] = there, set(values[v][u])
                        elif there == cost[y, x]:
                            values[y][x] |= values[v][u]
    assert all(float(found[y, x]) in values[y][x] for y in range(12) for x in range(14))


def test_a_lamp_in_the_air_that_a_blur_has_swallowed_hangs_there_again() -> None:
    near = block()
    depth_m, rgb = board(near)
    lamp = np.s_[10, 100]
    depth_m[lamp], rgb[lamp] = 2.0, 30.0
    soft_m = blurred(depth_m, 2.0)
    assert soft_m[lamp] > 3.0
    found = mended(soft_m, rgb).depth_m
    assert found[lamp] == pytest.approx(2.0, rel=0.15)
    assert found[10, 102] == pytest.approx(FAR_M, rel=0.05)


def test_depth_that_holds_nothing_is_background() -> None:
    _, rgb = board(block())
    assert np.isinf(mended(np.full(SIZE, np.nan, np.float32), rgb).depth_m).all()


def test_exact_depth_is_left_as_it_is_when_asked() -> None:
    """In Python; NaN is a hole by default and a mistake in depth that is exact."""
    depth_m, rgb = board(block())
    soft_m, lens = blurred(depth_m, 2.0), {"lens": mrbokeh.Lens(focal_length_mm=50.0, f_number=1.4), "focus": 4.0}
    by_default, as_it_is, exact = (
        mrbokeh.render(rgb, each, exact_depth=is_exact, **lens) for each, is_exact in ((soft_m, False), (soft_m, True), (depth_m, True))
    )
    off = [float(np.square(each - exact).mean()) for each in (by_default, as_it_is)]
    assert off[0] < 0.5 * off[1]
    soft_m[10:14, 10:14] = np.nan
    assert np.isfinite(mrbokeh.render(rgb, soft_m, **lens)).all()
    with pytest.raises(InputError, match="NaN"):
        mrbokeh.render(rgb, soft_m, exact_depth=True, **lens)
