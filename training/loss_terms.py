"""What else a loss may look at than pixels: the light of a neighbourhood, and edges. Errors are (B, C, H, W), weights broadcast to them."""

import math

import torch
from torch import Tensor
from torch.nn import functional

_TINY = 1e-6


def weighted_mean_square(error: Tensor, weight: Tensor) -> Tensor:
    return (weight * error.square()).sum() / weight.sum().clamp(min=_TINY)


def local_light_error(error: Tensor, counted: Tensor, largest_coc_px: float) -> Tensor:
    """The mean error about each pixel, under a Gaussian as wide as the largest blur, of the pixels that count.

    Blur moves light within a circle of confusion and neither takes nor makes any. A Gaussian and no box, because a box sees a light that
    moved by one pixel across its side: with 16 px, twelve times as much as one that lost a tenth. The standard deviation is half of
    the largest diameter. Next to pixels that do not count it is the mean of the others (normalised convolution, Knutsson and Westin 1993).
    """
    sigma_px = max(0.5 * largest_coc_px, 0.5)
    return gaussian(counted * error, sigma_px) / gaussian(counted, sigma_px).clamp(min=1e-12)


def gradient_error(error: Tensor, weight: Tensor) -> Tensor:
    """Mean square difference of the error between neighbours, right and down, where both count: blur too much or too little of an edge."""
    total = count = error.new_zeros(())
    for axis in (2, 3):
        length = error.shape[axis] - 1
        difference = error.narrow(axis, 1, length) - error.narrow(axis, 0, length)
        both = torch.minimum(weight.narrow(axis, 1, length), weight.narrow(axis, 0, length))
        total, count = total + (both * difference.square()).sum(), count + both.sum()
    return total / count.clamp(min=_TINY)


def gaussian(picture: Tensor, sigma_px: float) -> Tensor:
    """(B, C, H, W) convolved with a normalised Gaussian cut off at 3 standard deviations; black beyond the border."""
    radius = math.ceil(3.0 * sigma_px)
    offsets = torch.arange(-radius, radius + 1, dtype=picture.dtype, device=picture.device)
    kernel = torch.exp(-0.5 * (offsets / sigma_px).square())
    kernel = kernel / kernel.sum()
    planes = picture.reshape(-1, 1, *picture.shape[2:])
    planes = functional.conv2d(planes, kernel[None, None, None, :], padding=(0, radius))
    return functional.conv2d(planes, kernel[None, None, :, None], padding=(radius, 0)).reshape(picture.shape)
