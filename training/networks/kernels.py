"""Depthwise convolutions with a fast gradient, and the kernels with which networks start.

Blur of d pixels needs kernels d + 1 wide, and PyTorch's own gradient with respect to depthwise weights grows on a CPU much faster than
the convolution itself: one of 35 x 35 over 128 x 128 pixels took 170 times as long backward as forward. The gradient of a kernel is the
correlation of the input with the gradient of the output, of which only the kernel's own pixels are needed, and that of the input
is a convolution. Fourier transforms give both in about the time of the convolution forward. On a GPU they give all three.
"""

import math
from dataclasses import replace
from typing import Any

import numpy as np
import scipy.fft
import torch
from torch import Tensor, nn
from torch.nn import functional

from mrbokeh.optics.aperture import Aperture

LEAST_SIZE = 9
"""Width of kernels from which on the transforms are faster (half the time at 9, a twentieth at 21, less than a hundredth at 35)."""
LEAST_SIZE_ON_GPU = 5
_CHANNELS_AT_ONCE = 64  # bounds the memory of the transforms
FLAT_SHARE, FLAT_SHARE_IN_FOCUS = 0.05, 0.005  # of a fresh kernel, so that every one of its pixels can learn
# Several bases of a bin must begin apart, or they would all learn the same: discs clipped from different sides, as cat-eyes are, on
# floors that lean to these sides (in focus, where a disc has no shape, the floor alone). Their mean leans nowhere.
CAT_EYE, LEAN = 0.6, 0.5


def depthwise(maps: Tensor, kernels: Tensor, bias: Tensor | None = None, padding: int = 0) -> Tensor:
    """Convolve every channel of (B, C, H, W) with its own (C, 1, k, k): `functional.conv2d` with C groups, in value and in gradient."""
    if not _worth_it(maps, kernels):
        return functional.conv2d(maps, kernels, bias, padding=padding, groups=kernels.shape[0])
    blurred: Tensor = (_Depthwise if maps.device.type == "cpu" else _TransformedDepthwise).apply(maps, kernels, padding)
    return blurred if bias is None else blurred + bias[:, None, None]


def pointwise(maps: Tensor, convolution: nn.Conv2d) -> Tensor:
    """Return a 1x1 convolution in groups; on a GPU that learns as one product of matrices, since grouped ones are slow backward there."""
    if maps.device.type == "cpu" or torch.compiler.is_exporting() or not torch.is_grad_enabled():
        return convolution(maps)  # type: ignore[no-any-return]
    return pointwise_product(maps, convolution)


def pointwise_product(maps: Tensor, convolution: nn.Conv2d) -> Tensor:
    batch, _, height, width = maps.shape
    weight = convolution.weight.view(convolution.groups, -1, convolution.in_channels // convolution.groups)
    product = weight @ maps.reshape(batch, convolution.groups, -1, height * width)
    result = product.view(batch, -1, height, width)
    return result if convolution.bias is None else result + convolution.bias[:, None, None]


def _worth_it(maps: Tensor, kernels: Tensor) -> bool:
    """Tell whether Fourier transforms pay: in single precision, with wide kernels, and if a gradient is needed at all."""
    if torch.compiler.is_exporting() or not (torch.is_grad_enabled() and kernels.requires_grad):
        return False
    least = LEAST_SIZE if maps.device.type == "cpu" else LEAST_SIZE_ON_GPU
    return kernels.shape[-1] >= least and not torch.is_autocast_enabled(maps.device.type)


class _Depthwise(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, maps: Tensor, kernels: Tensor, padding: int) -> Tensor:
        ctx.save_for_backward(maps, kernels)
        ctx.padding = padding
        return functional.conv2d(maps, kernels, padding=padding, groups=kernels.shape[0])

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor | None, Tensor | None, None]:  # type: ignore[override]
        maps, kernels = ctx.saved_tensors
        parts = [
            _gradients(maps[:, channels], kernels[channels, 0], gradient[:, channels], ctx.padding, ctx.needs_input_grad[:2])
            for channels in (slice(start, start + _CHANNELS_AT_ONCE) for start in range(0, maps.shape[1], _CHANNELS_AT_ONCE))
        ]
        of_maps = torch.cat([each for each, _ in parts if each is not None], dim=1) if ctx.needs_input_grad[0] else None
        of_kernels = torch.cat([each for _, each in parts if each is not None])[:, None] if ctx.needs_input_grad[1] else None
        return of_maps, of_kernels, None


def _gradients(
    maps: Tensor, kernels: Tensor, gradient: Tensor, padding: int, wanted: tuple[bool, bool]
) -> tuple[Tensor | None, Tensor | None]:
    """Return (of the maps, of the kernels (C, k, k)), each if needed.

    With out(p) = sum over o of maps(p + o - padding) kernel(o), that of maps(q) is sum over o of gradient(q + padding - o) kernel(o), and
    that of kernel(o) the sum over p of maps(p + o - padding) gradient(p).
    """
    size, (height, width), lengths = kernels.shape[-1], maps.shape[-2:], _lengths(maps, padding)
    error = torch.fft.rfft2(gradient.contiguous(), s=lengths)
    of_maps = of_kernels = None
    if wanted[0]:
        whole = torch.fft.irfft2(error * torch.fft.rfft2(kernels, s=lengths), s=lengths)
        of_maps = whole[..., padding : padding + height, padding : padding + width]
    if wanted[1]:
        seen = torch.fft.rfft2(functional.pad(maps.contiguous(), (padding,) * 4), s=lengths)
        of_kernels = torch.fft.irfft2((seen * error.conj()).sum(dim=0), s=lengths)[:, :size, :size]
    return of_maps, of_kernels


def _lengths(maps: Tensor, padding: int) -> list[int]:
    return [scipy.fft.next_fast_len(length + 2 * padding, real=True) for length in maps.shape[-2:]]


class _TransformedDepthwise(torch.autograd.Function):
    """The convolution and its gradients by transforms alone; spectra of the way forward serve the way back.

    Transforms as long as the padded input hold no wrap-around where every pixel of a kernel lies within it.
    """

    @staticmethod
    def forward(ctx: Any, maps: Tensor, kernels: Tensor, padding: int) -> Tensor:
        lengths, (height, width) = _lengths(maps, padding), maps.shape[-2:]
        seen = torch.fft.rfft2(functional.pad(maps.contiguous(), (padding,) * 4), s=lengths)
        spectra = torch.fft.rfft2(kernels[:, 0], s=lengths)
        ctx.save_for_backward(seen, spectra)
        ctx.lengths, ctx.sizes, ctx.padding = lengths, (height, width, kernels.shape[-1]), padding
        out = torch.fft.irfft2(seen * spectra.conj(), s=lengths)
        rows, columns = (length + 2 * padding - kernels.shape[-1] + 1 for length in (height, width))
        return out[..., :rows, :columns].contiguous()

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor, Tensor, None]:  # type: ignore[override]
        (seen, spectra), (height, width, size), padding = ctx.saved_tensors, ctx.sizes, ctx.padding
        error = torch.fft.rfft2(gradient.contiguous(), s=ctx.lengths)
        whole = torch.fft.irfft2(error * spectra, s=ctx.lengths)
        of_maps = whole[..., padding : padding + height, padding : padding + width]
        of_kernels = torch.fft.irfft2((seen * error.conj()).sum(dim=0), s=ctx.lengths)[:, None, :size, :size]
        return of_maps.contiguous(), of_kernels.contiguous(), None


def disc_kernel(size: int, diameter_px: float) -> Tensor:
    """Return (size, size): a disc with exact pixel coverage, sum 1."""
    return _kernel(Aperture.disc(sides=64), size, diameter_px)


def fresh_kernels(n: int, knots_px: list[float], bases: int, initialisation: str) -> Tensor:
    """Return (bins * bases, 2n+1, 2n+1), bases fastest: a kernel is their magnitude over its sum; a typical one is 1.

    knots_px: signed diameters of the bins that have this size. Discs, or by "default" flat squares.
    """
    size = 2 * n + 1
    share = 1.0 if initialisation != "disc" else FLAT_SHARE_IN_FOCUS if n == 1 else FLAT_SHARE
    openings, floors = _openings(bases), _floors(n, bases)
    kernels = [
        (1.0 - share) * _kernel(opening, size, max(1.0, abs(knot))) + share * floor
        for knot in knots_px
        for opening, floor in zip(openings, floors, strict=True)
    ]
    return torch.stack(kernels) * size**2


def _kernel(opening: Aperture, size: int, diameter_px: float) -> Tensor:
    kernel = np.zeros((size, size), np.float32)
    psf = opening.rasterize(min(diameter_px, 0.98 * size)).kernel
    margin = (size - psf.shape[0]) // 2
    kernel[margin : size - margin, margin : size - margin] = psf
    return torch.from_numpy(kernel)


def _sides(bases: int) -> list[tuple[float, float]]:
    """Return evenly spread directions, one for each base; none for a single one."""
    angles = [2.0 * math.pi * base / bases for base in range(bases)]
    return [(math.cos(angle), math.sin(angle)) for angle in angles] if bases > 1 else [(0.0, 0.0)]


def _openings(bases: int) -> list[Aperture]:
    disc = Aperture.disc(sides=64)
    return [replace(disc, cat_eye=CAT_EYE).seen(1, side) for side in _sides(bases)] if bases > 1 else [disc]


def _floors(n: int, bases: int) -> list[Tensor]:
    """Return kernels (2n+1, 2n+1) with sum 1, each LEAN more at its own side than in the middle."""
    along = torch.arange(-n, n + 1) / n
    return [(1.0 + LEAN * (x * along + y * along[:, None]) / math.sqrt(2.0)) / (2 * n + 1) ** 2 for x, y in _sides(bases)]
