"""Lights: what counts as one, against the plain definition, and what takes its place."""

import numpy as np
import pytest

from mrbokeh.layering.highlights import find_highlights, mark_highlights, without_highlights


def picture(seed: int, size: tuple[int, int]) -> np.ndarray:
    """Texture with lights of all strengths, many of them near one another and on the border."""
    rng = np.random.default_rng(seed)
    values = rng.uniform(0.05, 1.0, (*size, 4)).astype(np.float32)
    bright = rng.uniform(size=size) < 0.1
    values[bright, :3] *= rng.uniform(1.0, 50.0, (bright.sum(), 3)).astype(np.float32)
    return values


@pytest.mark.parametrize("size", [(1, 1), (2, 9), (7, 3), (40, 61)])
def test_a_light_is_four_times_as_bright_as_most_of_the_25_pixels_around(size: tuple[int, int]) -> None:
    """The plain definition, window by window; beyond the border the last pixel is repeated."""
    values = picture(sum(size), size)
    brightness = values[..., :3].max(axis=2)
    around = np.lib.stride_tricks.sliding_window_view(np.pad(brightness, 2, mode="edge"), (5, 5)).reshape(*size, 25)
    expected = (4.0 * around < brightness[..., None]).sum(axis=2) >= 13
    np.testing.assert_array_equal(find_highlights(values), expected)
    assert size[0] < 40 or 50 < expected.sum() < 300


def test_lights_do_not_depend_on_bands_and_give_way_to_the_median_around_them() -> None:
    values = picture(5, (40, 61))
    in_bands = np.empty((40, 61), np.bool_)
    for top, bottom in ((0, 1), (1, 4), (4, 39), (39, 40)):
        mark_highlights(in_bands, values, top, bottom)
    np.testing.assert_array_equal(in_bands, find_highlights(values))
    values = np.full((9, 9, 4), 0.25, np.float32)
    assert without_highlights(values) is values
    values[4, 4, :3] = 100.0
    np.testing.assert_array_equal(without_highlights(values), np.full((9, 9, 4), 0.25, np.float32))
    assert values[4, 4, 0] == 100.0
