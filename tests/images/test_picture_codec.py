"""What is written is what is stored, and codes mean what the standards say."""

from pathlib import Path

import numpy as np
import pytest

from mrbokeh.images.picture_codec import codes_of, even_codes, linear_from_codes, stored_pixels, stored_rgb, write_stored


@pytest.mark.parametrize("suffix", [".png", ".TIF"])
@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
@pytest.mark.parametrize("shape", [(5, 7), (5, 7, 3), (5, 7, 4)])
def test_numbers_come_back(tmp_path: Path, suffix: str, dtype: type, shape: tuple[int, ...]) -> None:
    """Grey as three equal channels; in the file blue is first, which is the third of ours."""
    pixels = np.random.default_rng(1).integers(0, np.iinfo(dtype).max, shape).astype(dtype)
    write_stored(tmp_path / f"a{suffix}", pixels)
    stored = stored_rgb(tmp_path / f"a{suffix}")
    np.testing.assert_array_equal(stored, pixels if pixels.ndim == 3 else np.repeat(pixels[..., None], 3, axis=2))
    assert stored.dtype == dtype
    if pixels.ndim == 3:
        np.testing.assert_array_equal(stored_pixels(tmp_path / f"a{suffix}")[..., 0], pixels[..., 2])


def test_codes_are_clipped_and_numbers_that_are_none_are_black() -> None:
    values = np.array([np.nan, -np.inf, -0.1, 0.0, 0.5, 1.0, 7.0, np.inf], np.float32)
    expected = [0, 0, 0, 0, 128, 255, 255, 255]
    assert even_codes(values, np.uint8).tolist() == expected
    pixels = np.broadcast_to(values[:, None, None], (8, 1, 3))
    assert codes_of(pixels, np.uint8, "linear")[:, 0, 0].tolist() == expected
    # IEC 61966-2-1: linear 0.5 is 1.055 * 0.5^(1 / 2.4) - 0.055 = 0.7354 of 255.
    assert codes_of(pixels, np.uint8, "srgb")[:, 0, 0].tolist() == [*expected[:4], 188, *expected[5:]]


def test_alpha_is_not_curved() -> None:
    codes = np.full((1, 1, 4), 128, np.uint8)
    linear = linear_from_codes(codes, "srgb", Path("a.png"))[0, 0]
    # ((128 / 255 + 0.055) / 1.055)^2.4 = 0.2159
    np.testing.assert_allclose(linear, [0.2159, 0.2159, 0.2159, 128 / 255], atol=1e-4)
