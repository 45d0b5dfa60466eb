"""Laplacian spreadlets by torch: on an NVIDIA GPU, or on any processor that torch runs on (Leimkuehler et al. 2018, Section 6).

Two ways in. `LaplacianSpreadlets(device="cuda")` renders as ever and hands its sums to the device (`_sums.add_light_on`).
`TorchSpreadlets` is for what has to be quick: layers lie on the device as tensors, each pixel finds its kernel there, and the
picture stays there.

Sums are taken in whole numbers of 64 bits, scaled so that the largest sum that can occur is 2**61 at most. Whole numbers add up
the same in any order, so that atomic additions, chunks of any size and the Triton kernel all give the same bits, and a unit is
finer than the rounding of double precision of the largest sum. What may differ between devices, by rounding, is the integration:
sine transforms by torch.fft in double precision. In single precision they would be off by 2e-5 in a picture up to 1, and by 1e-4
where a lamp makes a disc of 80 (tests/bench/bench_torch_spreadlets.py measures it).

torch comes with the extra `train`; without it, importing this package says so.
"""

try:
    import torch as _torch  # noqa: F401
except ModuleNotFoundError as missing:
    from mrbokeh.system.errors import MissingExtraError

    raise MissingExtraError("torch", "train") from missing

from mrbokeh.renderers.spreadlets.torch_spreadlets._picture import DeviceLayer, TorchSpreadlets

__all__ = ["DeviceLayer", "TorchSpreadlets"]
