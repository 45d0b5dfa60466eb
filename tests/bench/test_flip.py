"""FLIP by what its paper says of it: its ends, and what it grows with."""

import cv2
import numpy as np
import pytest

from tests.bench.flip import flip

SIZE = (64, 80)


def flat(*rgb: float) -> np.ndarray:
    return np.broadcast_to(np.array(rgb, np.float32), (*SIZE, 3)).copy()


def texture() -> np.ndarray:
    coarse = np.random.default_rng(3).random((16, 20, 3)).astype(np.float32)
    return np.kron(coarse, np.ones((4, 4, 1), np.float32))


def test_the_ends() -> None:
    """Equal pictures differ by nothing. Green and blue are defined as 1; white and black 0.97 (100 to the power of 0.7, Section 4.1)."""
    np.testing.assert_array_equal(flip(texture(), texture()), 0.0)
    np.testing.assert_allclose(flip(flat(0, 1, 0), flat(0, 0, 1)), 1.0, atol=1e-6)
    largest = 41.27  # of the green and the blue of Rec.709
    knee = 0.4 * largest
    expected = 0.95 + 0.05 * (100.0**0.7 - knee) / (largest - knee)
    np.testing.assert_allclose(flip(flat(1, 1, 1), flat(0, 0, 0)), expected, atol=1e-3)


def test_it_grows_with_blur_and_is_the_same_both_ways() -> None:
    values = [flip(texture(), cv2.GaussianBlur(texture(), (0, 0), sigma)).mean() for sigma in (0.5, 1.0, 2.0, 4.0)]
    assert all(np.diff(values) > 0.005) and values[0] > 0.0 and values[-1] < 1.0
    other = cv2.GaussianBlur(texture(), (0, 0), 2.0)
    np.testing.assert_allclose(flip(texture(), other), flip(other, texture()), atol=1e-12)


def test_a_lost_edge_counts_more_than_a_shade() -> None:
    """The same difference of colour, once as an edge that is not there (Section 4.2) and once all over; from afar both fade."""
    grey, edge, shade = flat(0.2, 0.2, 0.2), flat(0.2, 0.2, 0.2), flat(0.22, 0.22, 0.22)
    edge[:, 40:] = 0.22
    assert flip(grey, edge)[:, 41:43].mean() > 1.2 * flip(grey, shade).mean()
    fine = texture()[::4, ::4].repeat(1, axis=0)
    near, far = (flip(fine, np.full_like(fine, 0.5), density).mean() for density in (30.0, 120.0))
    assert far < near


def test_pictures_are_clipped_to_what_is_shown() -> None:
    assert flip(flat(1, 1, 1), flat(7, 7, 7)).max() == pytest.approx(0.0, abs=1e-12)
