import numpy as np
import pytest
from skimage.metrics import structural_similarity

from mrbokeh.errors import InputError
from mrbokeh.image_metrics import depth_edge_mask, edge_psnr, energy_ratio, psnr, ssim


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
    assert edge_psnr(result, truth, depth_m, 5) == float("inf")
    assert depth_edge_mask(depth_m, 0)[0].nonzero()[0].tolist() == [24, 25]


def test_edge_psnr_without_edges_says_so() -> None:
    with pytest.raises(InputError, match="mask is empty"):
        edge_psnr(picture(0), picture(0), np.ones((40, 50)), 3)


def test_energy_ratio_sees_light_beyond_white() -> None:
    assert energy_ratio(np.full((2, 2), 30.0), np.full((2, 2), 10.0)) == pytest.approx(3.0)


def test_shapes_must_agree() -> None:
    with pytest.raises(InputError, match="one shape"):
        psnr(np.zeros((2, 2)), np.zeros((2, 3)))
