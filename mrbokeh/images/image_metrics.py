"""Measures of how alike two pictures are: PSNR, SSIM, light that was lost, made or leaked, and flicker of a film."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool, Float

from mrbokeh.system.errors import InputError

# Two pictures of one shape (H, W) or (H, W, C); the functions check it themselves and say it in words.
Image = Float[np.ndarray, "..."]


def psnr(result: Image, truth: Image, peak: float = 1.0, mask: Bool[np.ndarray, "height width"] | None = None) -> float:
    """Return the peak signal-to-noise ratio in dB of pictures clipped to [0, peak]; inf if they are equal.

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
    """Return the mean structural similarity (Wang et al. 2004: Gaussian window of 1.5 px, K1 0.01, K2 0.03), averaged over channels."""
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
    """Return the pixels within `reach_px` of a jump in depth, where occlusion decides the picture."""
    from scipy.ndimage import binary_dilation, maximum_filter, minimum_filter

    dioptres = 1.0 / depth_m
    jump = maximum_filter(dioptres, 3) - minimum_filter(dioptres, 3) > least_step_dioptres
    return binary_dilation(jump, iterations=reach_px) if reach_px > 0 else jump


def energy_ratio(result: Image, truth: Image) -> float:
    """Return the light of the result over the light of the truth, unclipped: 1 if nothing was lost or made."""
    _require_same_shape(result, truth)
    return float(result.astype(np.float64).sum() / truth.astype(np.float64).sum())


def leak(result: Image, truth: Image, band: Bool[np.ndarray, "height width"]) -> float:
    """Return the surplus light of the result within `band` over the light of the truth there; both are clipped to [0, 1].

    0 means that nothing leaked; missing light does not make up for it. With a band on the sharp side of depth edges this is the
    blur of one side that runs over the other. nan if the band is empty or black.
    """
    _require_same_shape(result, truth)
    shown, expected = np.clip(result[band], 0, 1).astype(np.float64), np.clip(truth[band], 0, 1)
    light = float(expected.sum(dtype=np.float64))
    return float(np.maximum(shown - expected, 0.0).sum()) / light if light > 0 else float("nan")


def light_error(
    result: Image, truth: Image, mask: Bool[np.ndarray, "height width"], saturated: Bool[np.ndarray, "height width"] | None = None
) -> float:
    """Return absolute differences over the light of the truth within `mask`, unclipped: 0 is perfect, 0.5 discs of half the light.

    saturated: where the truth says only "at least that much", so that more is no error. nan where the mask is empty or black.
    """
    _require_same_shape(result, truth)
    shown, expected = result[mask].astype(np.float64), truth[mask].astype(np.float64)
    if saturated is not None:
        shown = np.where(saturated[mask][(...,) + (None,) * (shown.ndim - 1)], np.minimum(shown, expected), shown)
    light = float(expected.sum())
    return float(np.abs(shown - expected).sum()) / light if light > 0 else float("nan")


def flicker(frames: Sequence[Image], truth: Sequence[Image]) -> float:
    """Return how much a film jumps that the true one does not: RMS error of second differences in time, over 4.

    An error that stays, or that grows evenly, scores 0; one that alternates by +a and -a from frame to frame scores a. All is
    clipped to [0, 1]. Raises InputError for fewer than three frames.
    """
    if len(frames) != len(truth) or len(frames) < 3:
        raise InputError(f"flicker needs as many frames as the true film, at least three, got {len(frames)} and {len(truth)}")
    squared, count = 0.0, 0
    for middle in range(1, len(frames) - 1):
        around = slice(middle - 1, middle + 2)
        jump = _second_difference(frames[around]) - _second_difference(truth[around])
        squared, count = squared + float((jump**2).sum()), count + jump.size
    return float(np.sqrt(squared / count)) / 4.0


def _second_difference(three: Sequence[Image]) -> Image:
    before, now, after = (np.clip(each, 0, 1).astype(np.float64) for each in three)
    _require_same_shape(before, after)
    return before - 2.0 * now + after


def _require_same_shape(result: np.ndarray, truth: np.ndarray) -> None:
    if result.shape != truth.shape:
        raise InputError(f"pictures to compare must have one shape, but came with {result.shape} and {truth.shape}: crop or resize one")
