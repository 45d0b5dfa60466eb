"""Light drawn out along its path: energy, place, shape, and what does not move."""

import numpy as np
import pytest

from mrbokeh.layering.motion import drawn_out, motion_reach_px


def point(motion_px: tuple[float, float], size: int = 41) -> np.ndarray:
    values = np.zeros((size, size, 4), np.float32)
    values[size // 2, size // 2] = 1.0
    motion = np.zeros((size, size, 2), np.float32)
    motion[size // 2, size // 2] = motion_px
    return drawn_out(values, np.full((size, size), 5.0, np.float32), motion)[0][..., 0].astype(np.float64)


def path_share(motion_px: tuple[float, float], size: int = 41, times: int = 20000) -> np.ndarray:
    """Every pixel's mean of the tent (1 - |dx|) (1 - |dy|) around it over the path: what sharing among four pixels tends to."""
    time = (np.arange(times) + 0.5) / times - 0.5
    cells = np.arange(size)[:, None] - size // 2
    right, down = (np.maximum(0.0, 1.0 - np.abs(cells - motion * time)) for motion in motion_px)
    return down @ right.T / times


@pytest.mark.parametrize("motion_px", [(0.3, 0.0), (6.0, 0.0), (0.0, -7.3), (5.2, 11.7), (-14.1, 3.3), (12.0, 12.0)])
def test_a_point_draws_its_path(motion_px: tuple[float, float]) -> None:
    drawn = point(motion_px)
    assert drawn.sum() == pytest.approx(1.0, abs=1e-6)
    y, x = np.mgrid[:41, :41] - 20
    assert ((drawn * x).sum(), (drawn * y).sum()) == pytest.approx((0.0, 0.0), abs=1e-5)
    np.testing.assert_allclose(drawn, path_share(motion_px), atol=0.03 * drawn.max())
    reach = motion_reach_px(np.array([[motion_px]], np.float32))
    assert not drawn[np.maximum(np.abs(x), np.abs(y)) > reach].any()


def test_its_spread_along_the_path_is_that_of_even_motion() -> None:
    """A segment of length L has the variance L^2 / 12 along itself; sharing among pixels adds less than 1/4 px^2."""
    drawn = point((24.0, 0.0))
    x = np.arange(41) - 20
    assert (drawn.sum(axis=0) * x**2).sum() == pytest.approx(24.0**2 / 12.0 + 1.0 / 6.0, abs=0.1)


def test_what_does_not_move_stays_bit_for_bit_an_even_field_even_and_diameters_are_averaged_by_coverage() -> None:
    values = np.random.default_rng(0).uniform(-1.0, 1.0, (30, 40, 6)).astype(np.float32)
    values[..., 3] = 1.0
    coc_px = np.random.default_rng(1).uniform(-9.0, 9.0, (30, 40)).astype(np.float32)
    still, still_coc_px = drawn_out(values, coc_px, np.zeros((30, 40, 2), np.float32))
    np.testing.assert_array_equal(still, values)
    np.testing.assert_array_equal(still_coc_px, coc_px)
    # As much light comes to a pixel as leaves it, where all move alike.
    even, motion = np.full((40, 60, 4), 0.5, np.float32), np.full((40, 60, 2), (7.7, -3.1), np.float32)
    np.testing.assert_allclose(drawn_out(even, even[..., 0], motion)[0][6:-6, 6:-6], 0.5, rtol=1e-6)
    values, coc_px, motion = np.zeros((9, 21, 4), np.float32), np.zeros((9, 21), np.float32), np.zeros((9, 21, 2), np.float32)
    values[4, 9], values[4, 11], coc_px[4, 9], coc_px[4, 11] = 0.25, 0.75, 4.0, 8.0
    motion[4, 9], motion[4, 11] = (4.0, 0.0), (4.0, 0.0)
    assert drawn_out(values, coc_px, motion)[1][4, 10] == pytest.approx(0.25 * 4.0 + 0.75 * 8.0)
