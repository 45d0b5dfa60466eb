"""Layered reconstruction: how the whole and its parts are compared on coarse pixels."""

import numpy as np
import pytest

from mrbokeh.renderers.layered_reconstruction._tile_data import WindowLayer
from mrbokeh.renderers.layered_reconstruction._tiles_numba import (
    COARSE_PX,
    box_of,
    coarse,
    cropped,
    ratio_of,
    scale_by_coarse,
    too_detailed,
)


def layer(rng: np.random.Generator) -> WindowLayer:
    """Of a tile of 32 x 32 px, with bands of 5 + 10 and 7 + 10 px."""
    planes = rng.uniform(size=(32 + 2 * 17, 32 + 2 * 15, 5)).astype(np.float32)
    return WindowLayer(planes, -9.0, 8.0, 12.0, 5, 7, 10)


def test_a_coarse_layer_is_the_mean_of_its_pixels_and_a_cropped_one_holds_what_is_read() -> None:
    """Those of the tile lie behind bands of ceil(1/2 8/4) = 1, ceil(1/2 12/4) = 2 and ceil(9/4) + 1 = 4 coarse pixels."""
    fine = layer(np.random.default_rng(0))
    small = coarse(fine, 32, 32)
    assert small[1:] == (-9.0 / 4, 2.0, 3.0, 1, 2, 4) and small.planes.shape == (8 + 12, 8 + 10, 5)
    tile = fine.planes[17:49, 15:47]
    expected = tile.reshape(8, 4, 8, 4, 5).mean(axis=(1, 3))
    np.testing.assert_allclose(small.planes[6:14, 5:13], expected, rtol=1e-5)
    fine = layer(np.random.default_rng(1))
    part = cropped(fine, (4, 12, 8, 32))
    np.testing.assert_array_equal(part.planes, fine.planes[4 : 12 + 34, 8 : 32 + 30])


@pytest.mark.parametrize("side", [32, 13, 1])
def test_coarse_pixels_are_factors_linear_between_their_middles(side: int) -> None:
    """A ramp stays a ramp between the first and the last middle; 13 px are three coarse pixels and a quarter."""
    count = -(-side // COARSE_PX)
    x = (np.arange(count) + 0.5) * COARSE_PX
    ratio = np.broadcast_to(1.0 + 0.01 * x[:, None, None] + 0.02 * x[None, :, None], (count, count, 1)).astype(np.float32)
    picture = np.full((side, side, 1), 2.0, np.float32)
    scale_by_coarse(picture, np.ascontiguousarray(ratio))
    at = np.clip(np.arange(side) + 0.5, x[0], x[-1])
    np.testing.assert_allclose(picture[..., 0], 2.0 * (1.0 + 0.01 * at[:, None] + 0.02 * at[None, :]), rtol=1e-5)


def test_a_factor_turns_no_sign_and_where_it_would_have_to_is_found() -> None:
    """Of an even 1 parts make 0.5 and -1: the second is no factor, and is done in parts; so is light where the whole has none."""
    alike = np.ones((5, 5, 1), np.float32)
    np.testing.assert_array_equal(ratio_of(alike, 0.5 * alike), 0.5)
    np.testing.assert_array_equal(ratio_of(alike, -alike), 0.0)
    assert not too_detailed(alike, 0.5 * alike, ratio_of(alike, 0.5 * alike), 0.01).any(), "no detail"
    assert too_detailed(alike, -alike, ratio_of(alike, -alike), 0.5).all()
    dark = np.zeros_like(alike)
    np.testing.assert_array_equal(ratio_of(dark, alike), 1.0)
    assert too_detailed(dark, alike, ratio_of(dark, alike), 0.5).all()


def test_only_what_coarse_pixels_cannot_hold_is_found_whatever_the_exposure() -> None:
    """A ramp of differences is the mean of its 3 x 3 neighbours but at the border, where 1 % of the light is not over the tolerance;
    a single pixel of 10 % is, and no neighbour of it: its ninth is 1.1 %."""
    alike = np.ones((8, 8, 3), np.float32)
    ramp = np.broadcast_to(np.linspace(0.0, 0.07, 8, dtype=np.float32)[:, None, None], alike.shape)
    assert not too_detailed(alike, alike + ramp, ratio_of(alike, alike + ramp), 0.0125).any()
    apart = alike.copy()
    apart[2, 5, 1] = 1.1
    for exposure in (1.0, 1e-4, 1e4):
        one, other = alike * np.float32(exposure), apart * np.float32(exposure)
        found = too_detailed(one, other, ratio_of(one, other), 0.0125)
        assert np.argwhere(found).tolist() == [[2, 5]]
    assert box_of(found, 32, 32) == (8, 12, 20, 24)
    assert box_of(found, 10, 22) == (8, 10, 20, 22), "a tile that is cut"
    assert box_of(np.zeros_like(found), 32, 32) == (0, 0, 0, 0)
