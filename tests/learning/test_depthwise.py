"""Depthwise convolutions with a gradient of their own: the same numbers as PyTorch's, in far less time where kernels are wide."""

import time

import pytest
import torch
from torch import Tensor
from torch.nn import functional

from training.networks.kernels import LEAST_SIZE, depthwise


def plain(maps: Tensor, kernels: Tensor, bias: Tensor | None, padding: int) -> Tensor:
    return functional.conv2d(maps, kernels, bias, padding=padding, groups=kernels.shape[0])


@pytest.mark.parametrize(("size", "padding"), [(LEAST_SIZE, LEAST_SIZE // 2), (15, 0), (21, 10)])
def test_value_and_gradients_are_those_of_pytorch(size: int, padding: int) -> None:
    """Two pictures of 70 channels (more than are transformed at once) and sides that are no round numbers; to the rounding of sums of
    some thousand products in single precision."""
    torch.manual_seed(size)
    maps, kernels = torch.rand(2, 70, 37, 43, requires_grad=True), torch.rand(70, 1, size, size, requires_grad=True)
    bias, weight = torch.rand(70, requires_grad=True), torch.rand(2, 70, 37 + 2 * padding - size + 1, 43 + 2 * padding - size + 1)
    results = []
    for convolution in (plain, depthwise):
        blurred = convolution(maps, kernels, bias, padding)
        results.append((blurred.detach(), *torch.autograd.grad((weight * blurred).sum(), (maps, kernels, bias))))
    for expected, got in zip(*results, strict=True):
        assert got.shape == expected.shape
        assert float((got - expected).abs().max()) < 2e-6 * float(expected.abs().max())


def test_no_light_no_gradient() -> None:
    """What Adam divides by its own size must not be noise: a channel without light, or without error, has a gradient of exactly 0."""
    maps, kernels = torch.rand(1, 2, 32, 32), torch.rand(2, 1, 11, 11, requires_grad=True)
    maps[:, 0] = 0.0
    assert (torch.autograd.grad(depthwise(maps, kernels, padding=5).square().sum(), kernels)[0][0] == 0).all()
    weight = torch.tensor([1.0, 0.0])[None, :, None, None]
    assert (torch.autograd.grad((weight * depthwise(maps + 1.0, kernels, padding=5)).sum(), kernels)[0][1] == 0).all()


def test_wide_kernels_learn_in_a_fraction_of_the_time() -> None:
    """The reason for all this: CPU seconds, which others on the machine do not change much; measured 20 to 60 times at 25 x 25."""
    maps, kernels = torch.rand(1, 4, 64, 64).contiguous(memory_format=torch.channels_last), torch.rand(4, 1, 25, 25, requires_grad=True)

    def cpu_s(convolution: object) -> float:
        began_s = time.process_time()
        for _ in range(3):
            torch.autograd.grad(convolution(maps, kernels, None, 12).sum(), kernels)  # type: ignore[operator]
        return time.process_time() - began_s

    cpu_s(depthwise)
    assert cpu_s(depthwise) < 0.5 * cpu_s(plain)
