import numpy as np
import pytest
from skimage.metrics import structural_similarity

from mrbokeh.images.image_metrics import depth_edge_mask, energy_ratio, flicker, leak, light_error, psnr, ssim
from tests.support.refusals import refused


def picture(seed: int) -> np.ndarray:
    return np.random.default_rng(seed).uniform(0, 1, (40, 50, 3)).astype(np.float32)


def test_psnr_of_a_known_error() -> None:
    """A constant error of 0.1 has a mean square of 0.01: 20 dB."""
    assert psnr(np.full((8, 8), 0.6), np.full((8, 8), 0.5)) == pytest.approx(20.0)
    assert psnr(picture(0), picture(0)) == float("inf")


def test_psnr_clips_to_the_peak() -> None:
    assert psnr(np.full((4, 4), 7.0), np.full((4, 4), 3.0)) == float("inf")


def test_ssim_agrees_with_scikit_image() -> None:
    a, b = picture(1), (0.7 * picture(1) + 0.3 * picture(2)).astype(np.float32)
    expected = structural_similarity(a, b, channel_axis=2, data_range=1.0, gaussian_weights=True, sigma=1.5, use_sample_covariance=False)
    assert ssim(a, b) == pytest.approx(expected, abs=1e-4)


def test_edge_psnr_looks_only_near_depth_edges() -> None:
    depth_m = np.full((40, 50), 1.0)
    depth_m[:, 25:] = 2.0
    truth, result = picture(3), picture(3)
    result[:, :10] += 0.3
    assert psnr(result, truth, mask=depth_edge_mask(depth_m, 5)) == float("inf")
    assert depth_edge_mask(depth_m, 0)[0].nonzero()[0].tolist() == [24, 25]


def test_edge_psnr_without_edges_says_so() -> None:
    refused("mask is empty", psnr, picture(0), picture(0), mask=depth_edge_mask(np.ones((40, 50)), 3))


def test_energy_ratio_sees_light_beyond_white() -> None:
    assert energy_ratio(np.full((2, 2), 30.0), np.full((2, 2), 10.0)) == pytest.approx(3.0)


def test_shapes_must_agree() -> None:
    refused("one shape", psnr, np.zeros((2, 2)), np.zeros((2, 3)))


def test_leak_counts_only_what_is_too_much_in_the_band() -> None:
    """In the band the truth is 0.5; half of it is 0.1 too bright, half 0.3 too dark: 0.05 too much on average, a tenth of 0.5."""
    truth = np.full((10, 20, 3), 0.5)
    band = np.zeros((10, 20), bool)
    band[:, 8:12] = True
    result = truth.copy()
    result[:5] += 0.1
    result[5:] -= 0.3
    assert leak(result, truth, band) == pytest.approx(0.1)
    result[:, :8] += 5.0
    result[:, 12:] += 5.0
    assert leak(result, truth, band) == pytest.approx(0.1)
    assert leak(truth - 0.2, truth, band) == 0.0
    assert np.isnan(leak(result, truth, np.zeros((10, 20), bool)))


def test_light_error_sees_highlights_that_were_clipped() -> None:
    """A disc of radiance 4 shown at white has lost three quarters of its light, which PSNR, clipped at white, does not see."""
    truth = np.full((6, 6, 3), 0.2)
    truth[2:4, 2:4] = 4.0
    disc = truth[..., 0] > 1
    clipped = np.minimum(truth, 1.0)
    assert psnr(clipped, truth) == float("inf")
    assert light_error(clipped, truth, disc) == pytest.approx(0.75)
    assert light_error(truth * 1.5, truth, disc) == pytest.approx(0.5)


def test_more_light_than_a_full_photosite_is_no_error() -> None:
    truth = np.ones((4, 4, 3))
    everywhere, saturated = np.ones((4, 4), bool), np.zeros((4, 4), bool)
    saturated[:2] = True
    assert light_error(truth * 3.0, truth, everywhere, saturated) == pytest.approx(1.0)  # 2 too much in the other half
    assert light_error(truth * 0.5, truth, everywhere, saturated) == pytest.approx(0.5)


def test_flicker_of_a_known_error() -> None:
    """Second difference of +a, -a, +a is 4 a, and over 4 it is a; an offset and an error that grows evenly have none."""
    truth = [np.full((5, 7, 3), 0.4 + 0.02 * t) for t in range(6)]
    assert flicker([frame + 0.03 * (-1) ** t for t, frame in enumerate(truth)], truth) == pytest.approx(0.03)
    assert flicker([frame + 0.1 + 0.01 * t for t, frame in enumerate(truth)], truth) == pytest.approx(0.0, abs=1e-12)
    assert flicker(truth, truth) == 0.0


def test_flicker_compares_with_the_true_film() -> None:
    """A film that bends as the true one does not flicker; one that stays still where the truth bends misses its second difference.

    t^2 / 50 has the second difference 0.04, over 4 that is 0.01."""
    truth = [np.full((3, 3), t * t / 50.0) for t in range(5)]
    assert flicker(truth, truth) == 0.0
    assert flicker([np.full((3, 3), 0.1)] * 5, truth) == pytest.approx(0.01)
    refused("at least three", flicker, truth[:2], truth[:2])
