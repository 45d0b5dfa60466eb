"""How alike two pictures are: PSNR, SSIM, PSNR near depth edges, and the light that was lost or made."""

import numpy as np
from jaxtyping import Bool, Float

from mrbokeh.errors import InputError

# Two pictures of one shape (H, W) or (H, W, C); the functions check it themselves and say it in words.
Image = Float[np.ndarray, "..."]


def psnr(result: Image, truth: Image, peak: float = 1.0, mask: Bool[np.ndarray, "height width"] | None = None) -> float:
    """Peak signal-to-noise ratio in dB; both pictures are clipped to [0, peak]. inf where they are equal.

    mask: which pixels count, all where it is None.
    """
    _require_same_shape(result, truth)
    squared = (np.clip(result, 0, peak).astype(np.float64) - np.clip(truth, 0, peak)) ** 2
    if mask is not None:
        if not mask.any():
            raise InputError("PSNR over no pixels: the mask is empty")
        squared = squared[mask]
    mean = float(squared.mean())
    return float("inf") if mean == 0 else float(10.0 * np.log10(peak**2 / mean))


def ssim(result: Image, truth: Image, peak: float = 1.0) -> float:
    """Mean structural similarity (Wang et al. 2004: Gaussian window of 1.5 px, K1 0.01, K2 0.03), averaged over channels."""
    from scipy.ndimage import gaussian_filter

    _require_same_shape(result, truth)
    x, y = np.clip(result, 0, peak).astype(np.float64), np.clip(truth, 0, peak).astype(np.float64)
    sigma_px = (1.5, 1.5) + (0.0,) * (x.ndim - 2)

    def local_mean(values: np.ndarray) -> np.ndarray:
        return gaussian_filter(values, sigma_px, truncate=3.5)

    mean_x, mean_y = local_mean(x), local_mean(y)
    variance_x, variance_y = local_mean(x * x) - mean_x**2, local_mean(y * y) - mean_y**2
    covariance = local_mean(x * y) - mean_x * mean_y
    c1, c2 = (0.01 * peak) ** 2, (0.03 * peak) ** 2
    similarity = (2 * mean_x * mean_y + c1) * (2 * covariance + c2) / ((mean_x**2 + mean_y**2 + c1) * (variance_x + variance_y + c2))
    border = 5
    return float(similarity[border:-border, border:-border].mean())


def depth_edge_mask(
    depth_m: Float[np.ndarray, "height width"], reach_px: int, least_step_dioptres: float = 0.05
) -> Bool[np.ndarray, "height width"]:
    """Pixels within `reach_px` of a jump in depth, where occlusion decides the picture."""
    from scipy.ndimage import binary_dilation, maximum_filter, minimum_filter

    dioptres = 1.0 / depth_m
    jump = maximum_filter(dioptres, 3) - minimum_filter(dioptres, 3) > least_step_dioptres
    return binary_dilation(jump, iterations=reach_px) if reach_px > 0 else jump


def edge_psnr(result: Image, truth: Image, depth_m: Float[np.ndarray, "height width"], reach_px: int, peak: float = 1.0) -> float:
    """PSNR over the pixels within `reach_px` of a depth edge."""
    return psnr(result, truth, peak, depth_edge_mask(depth_m, reach_px))


def energy_ratio(result: Image, truth: Image) -> float:
    """Light of the result over light of the truth, unclipped: 1 where nothing was lost or made."""
    _require_same_shape(result, truth)
    return float(result.astype(np.float64).sum() / truth.astype(np.float64).sum())


def _require_same_shape(result: np.ndarray, truth: np.ndarray) -> None:
    if result.shape != truth.shape:
        raise InputError(f"pictures to compare must have one shape, but came with {result.shape} and {truth.shape}: crop or resize one")
