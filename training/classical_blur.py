"""What a network must beat: a Gaussian of the right size; and light that is thrown without asking what hides it."""

import numpy as np
from jaxtyping import Float32

from mrbokeh.optics.aperture import Aperture

SIGMA_STEP_PX = 0.25


def sigma_per_coc(aperture: Aperture) -> float:
    """Standard deviation per axis of the aperture's blur over its circle of confusion: 1/4 for a disc, whose second moment it has.

    Measured on the aperture itself, so that a hexagon is given the somewhat narrower Gaussian that fits it.
    """
    diameter_px = 41.0
    kernel = aperture.rasterize(diameter_px).kernel
    offsets = np.arange(len(kernel)) - len(kernel) // 2
    squares = (kernel.sum(axis=0) + kernel.sum(axis=1)) @ offsets.astype(float) ** 2
    pixel_variance = 1.0 / 12.0
    return float(np.sqrt(squares / 2.0 - pixel_variance) / diameter_px)


def gaussian_scatter(
    rgb: Float32[np.ndarray, "height width 3"], coc_px: Float32[np.ndarray, "height width"], sigma_over_coc: float = 0.25
) -> Float32[np.ndarray, "height width 3"]:
    """Every pixel spreads its light as a Gaussian of its own size; the sum is divided by the weight that arrived."""
    light = np.dstack([rgb, np.ones(coc_px.shape, np.float32)])
    levels, shares = _levels(np.abs(coc_px) * sigma_over_coc)
    spread = np.zeros_like(light)
    for sigma, share in zip(levels, shares, strict=True):
        if share.any():
            spread += _blurred(light * share[..., None], sigma)
    return (spread[..., :3] / np.maximum(spread[..., 3:], 1e-6)).astype(np.float32)


def gaussian_gather(
    rgb: Float32[np.ndarray, "height width 3"], coc_px: Float32[np.ndarray, "height width"], sigma_over_coc: float = 0.25
) -> Float32[np.ndarray, "height width 3"]:
    """Every pixel is the mean of its surroundings under a Gaussian of its own size."""
    levels, shares = _levels(np.abs(coc_px) * sigma_over_coc)
    gathered = np.zeros_like(rgb)
    for sigma, share in zip(levels, shares, strict=True):
        if share.any():
            gathered += _blurred(rgb, sigma) * share[..., None]
    return gathered


def _levels(sigma_px: np.ndarray) -> tuple[np.ndarray, list[np.ndarray]]:
    """Standard deviations in steps, and how much of each pixel belongs to each (linear between two neighbours)."""
    position = sigma_px / SIGMA_STEP_PX
    count = int(np.ceil(position.max(initial=0.0))) + 1
    shares = [np.clip(1.0 - np.abs(position - level), 0.0, 1.0).astype(np.float32) for level in range(count)]
    return np.arange(count) * SIGMA_STEP_PX, shares


def _blurred(picture: np.ndarray, sigma_px: float) -> np.ndarray:
    from scipy.ndimage import gaussian_filter

    return picture if sigma_px == 0.0 else gaussian_filter(picture, (sigma_px, sigma_px, 0.0), mode="nearest", truncate=4.0)


def scatter_reference(
    rgb: Float32[np.ndarray, "height width 3"],
    coc_px: Float32[np.ndarray, "height width"],
    aperture: Aperture,
) -> Float32[np.ndarray, "height width 3"]:
    """The reference renderer with the aperture of the lens, as one opaque layer, at exactly these circles of confusion.

    The picture is continued beyond its border, from where light enters it.
    """
    from mrbokeh.images.layer import opaque
    from mrbokeh.renderers.scatter.scatter_reference import blur_layer

    margin = int(np.ceil(np.abs(coc_px).max(initial=0.0) / 2.0)) + 1
    around = ((margin, margin), (margin, margin))
    wide = opaque(np.pad(rgb, (*around, (0, 0)), mode="edge"), np.ones(np.array(coc_px.shape) + 2 * margin, np.float32))
    blurred = blur_layer(wide, np.pad(coc_px, around, mode="edge"), aperture)
    inside = np.s_[margin:-margin, margin:-margin]
    return (blurred.rgb[inside] / np.maximum(blurred.alpha[inside], 1e-6)[..., None]).astype(np.float32)
