import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from mrbokeh.images.color import (
    XYZ_from_rec709,
    convert,
    display_rgb8,
    linear_to_srgb,
    luminance,
    rec709_from_XYZ,
    srgb_to_linear,
    tone_map,
)


@given(st.floats(-0.5, 8.0, width=32))
def test_srgb_round_trip(linear: float) -> None:
    value = np.array([linear], np.float32)
    np.testing.assert_allclose(srgb_to_linear(linear_to_srgb(value)), value, rtol=2e-5, atol=1e-6)


def test_srgb_known_values() -> None:
    """IEC 61966-2-1: mid code 0.5 is 0.21404114 in linear light, 18 % grey is code 117.6 of 255."""
    np.testing.assert_allclose(srgb_to_linear(np.array([0.0, 0.5, 1.0])), [0.0, 0.21404114, 1.0], atol=1e-6)
    np.testing.assert_allclose(linear_to_srgb(np.array([0.18])) * 255, 117.6, atol=0.1)


def test_white_of_rec709_is_d65() -> None:
    x, y, z = XYZ_from_rec709 @ np.ones(3)
    np.testing.assert_allclose([x / (x + y + z), y / (x + y + z)], [0.3127, 0.3290], atol=1e-4)


def test_primaries_there_and_back() -> None:
    rgb = np.random.default_rng(0).uniform(0, 2, (4, 5, 3)).astype(np.float32)
    np.testing.assert_allclose(convert(convert(rgb, XYZ_from_rec709), rec709_from_XYZ), rgb, atol=1e-5)
    np.testing.assert_allclose(luminance(np.ones((1, 3), np.float32)), 1.0, atol=1e-6)


def test_tone_map_keeps_what_is_displayable_and_orders_the_rest() -> None:
    values = np.linspace(0, 20, 2001, dtype=np.float32)
    mapped = tone_map(values)
    np.testing.assert_array_equal(mapped[values <= 0.8], values[values <= 0.8])
    assert (np.diff(mapped) >= 0).all() and mapped.max() <= 1.0
    assert np.abs(np.diff(mapped)).max() <= 0.0101, "no step at the shoulder"


def test_display_encoding_of_black_and_white() -> None:
    assert display_rgb8(np.array([[0.0, 0.0, 0.0], [100.0, 100.0, 100.0]], np.float32)).tolist() == [[0] * 3, [255] * 3]
