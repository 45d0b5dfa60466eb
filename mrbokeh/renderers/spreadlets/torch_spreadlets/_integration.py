"""`mrbokeh.renderers.kernels.laplacian_integration.integrate` by transforms alone: no sweeps along columns, which a GPU has no use for.

The same operator with the same borders is diagonal under a sine transform of the second kind along rows (continued
antisymmetrically about the border) and of the first kind along columns (zeros one pixel beyond).
"""

from functools import lru_cache

import torch
from jaxtyping import Float
from torch import Tensor

from mrbokeh.system.errors import InputError

Planes = Float[Tensor, "channels height width"]


def integrate(source: Planes) -> Planes:
    """The planes whose 3x3 Laplacian is this, zero beyond the border; in the precision of the source, on its device."""
    _, height, width = source.shape
    if min(height, width) < 3:
        raise InputError(f"a Laplacian to integrate needs at least 3 x 3 pixels, got {width} x {height}")
    modes = _down(_along(source))
    modes *= _inverse(height, width, source.dtype, source.device)
    return _back_along(_down(modes))


@lru_cache(maxsize=8)
def _inverse(height: int, width: int, precision: torch.dtype, device: torch.device) -> Float[Tensor, "height width"]:
    """One over the Laplacian of every mode, with what the transforms there and back multiply by."""
    down = torch.cos(torch.pi * torch.arange(1, height + 1, dtype=torch.float64) / (height + 1))[:, None]
    right = torch.cos(torch.pi * torch.arange(1, width + 1, dtype=torch.float64) / width)
    eigenvalues = (-20.0 + 8.0 * (right + down) + 4.0 * right * down) / 6.0
    return (1.0 / (eigenvalues * 2.0 * (height + 1))).to(device, precision)


def _down(planes: Planes) -> Planes:
    """The sine transform of the first kind along columns; twice it is 2 (height + 1)."""
    border = torch.zeros_like(planes[:, :1])
    odd = torch.cat([border, planes, border, -planes.flip(1)], dim=1)
    return torch.fft.rfft(odd, dim=1).imag[:, 1 : planes.shape[1] + 1].neg()


def _along(planes: Planes) -> Planes:
    """The sine transform of the second kind along rows, as a cosine transform of every other pixel negated (Makhoul 1980)."""
    width = planes.shape[2]
    order = torch.cat([planes[..., ::2], -planes[..., 1::2].flip(2)], dim=2)
    half = torch.fft.rfft(order, dim=2) * _turn(width, planes.dtype, planes.device)
    rest = half.imag[..., 1 : (width + 1) // 2].flip(2).neg()
    return torch.cat([half.real, rest], dim=2).flip(2)


def _back_along(modes: Planes) -> Planes:
    """The inverse of `_along`."""
    width = modes.shape[2]
    cosine = modes.flip(2)
    beyond = torch.cat([torch.zeros_like(cosine[..., :1]), cosine.flip(2)[..., : width // 2]], dim=2)
    half = torch.complex(cosine[..., : width // 2 + 1].contiguous(), -beyond) * _turn(width, modes.dtype, modes.device).conj()
    order = torch.fft.irfft(half, n=width, dim=2)
    planes = torch.empty_like(modes)
    planes[..., ::2] = order[..., : (width + 1) // 2]
    planes[..., 1::2] = -order[..., (width + 1) // 2 :].flip(2)
    return planes


@lru_cache(maxsize=8)
def _turn(width: int, precision: torch.dtype, device: torch.device) -> Tensor:
    angle = -0.5 * torch.pi * torch.arange(width // 2 + 1, dtype=torch.float64) / width
    return torch.polar(torch.ones_like(angle), angle).to(device, torch.complex128 if precision == torch.float64 else torch.complex64)
