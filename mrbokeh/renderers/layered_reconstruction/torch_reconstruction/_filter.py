"""The sheared filter of partitions, all at once; the formulas of `layered_reconstruction._filter_numba`, in its words.

Sums are (..., 8): count, r, r^2, m_x, m_y, m_x^2, m_x m_y, m_y^2, with r half the signed circle of confusion.
"""

from typing import NamedTuple

import torch
from jaxtyping import Float64
from torch import Tensor

Sums = Float64[Tensor, "*partitions 8"]
Window = Float64[Tensor, "4"]
Number = Float64[Tensor, "*partitions"]


class Slopes(NamedTuple):
    """Mean slopes of a partition and the shares of them that the filter is sheared by."""

    r: Number
    m_x: Number
    m_y: Number
    kappa_u: Number
    kappa_t: Number


class Spread(NamedTuple):
    """A symmetric matrix of two by two."""

    xx: Number
    xy: Number
    yy: Number


def features(slopes: Tensor) -> Float64[Tensor, "*samples 8"]:
    """What samples with slopes (..., 3) add to a row of sums."""
    r, m_x, m_y = slopes.double().unbind(dim=-1)
    return torch.stack([torch.ones_like(r), r, r * r, m_x, m_y, m_x * m_x, m_x * m_y, m_y * m_y], dim=-1)


def sheared_slopes(sums: Sums, window: Window, sigma_x_px: float, bandwidth: float) -> Slopes:
    n, sum_r, sum_rr, sum_x, sum_y, sum_xx, sum_xy, sum_yy = sums.unbind(dim=-1)
    r, m_x, m_y = sum_r / n, sum_x / n, sum_y / n
    var_r = (sum_rr / n - r * r).clamp(min=0.0)
    var_xx, var_xy, var_yy = (sum_xx / n - m_x * m_x).clamp(min=0.0), sum_xy / n - m_x * m_y, (sum_yy / n - m_y * m_y).clamp(min=0.0)
    d_uu, d_uv, d_vv, d_tt = window
    out, det = _blur(r, m_x, m_y, window, sigma_x_px)
    # How far the slopes of single samples leave the mean one, within that band: trace and determinant of V^-1 D.
    half = 0.5 * (out.yy * d_uu - 2.0 * out.xy * d_uv + out.xx * d_vv) / det
    largest = half + torch.sqrt((half * half - (d_uu * d_vv - d_uv * d_uv) / det).clamp(min=0.0))
    trace_m = (out.yy * var_xx - 2.0 * out.xy * var_xy + out.xx * var_yy) / det
    kappa_u = 1.0 / (1.0 + bandwidth**2 * var_r * largest)
    return Slopes(r, m_x, m_y, kappa_u, 1.0 / (1.0 + bandwidth**2 * d_tt * trace_m))


def screen_covariance(slopes: Slopes, window: Window, sigma_x_px: float) -> Spread:
    """Of the Gaussian over the screen."""
    lens = slopes.kappa_u * (2.0 - slopes.kappa_u) * slopes.r**2
    shutter = slopes.kappa_t * (2.0 - slopes.kappa_t) * window[3]
    xx = sigma_x_px**2 + lens * window[0] + shutter * slopes.m_x**2
    return Spread(xx, lens * window[1] + shutter * slopes.m_x * slopes.m_y, sigma_x_px**2 + lens * window[2] + shutter * slopes.m_y**2)


def axes(v: Spread) -> tuple[Number, Number, Number]:
    """(sigma_u, sigma_v, theta) with sigma_u >= sigma_v and theta the angle of the u axis from x towards y."""
    middle, half = 0.5 * (v.xx + v.yy), torch.hypot(0.5 * (v.xx - v.yy), v.xy)
    return torch.sqrt(middle + half), torch.sqrt((middle - half).clamp(min=0.0)), 0.5 * torch.atan2(2.0 * v.xy, v.xx - v.yy)


def sheared_axes(sigma_u: Number, sigma_v: Number, theta: Number) -> tuple[Number, Number, Number]:
    """(s_u, s_v, beta) of Eq. 9: the same Gaussian as one along x after one along (beta, 1)."""
    cosine, sine = torch.cos(theta), torch.sin(theta)
    rho = torch.sqrt((sigma_v * cosine) ** 2 + (sigma_u * sine) ** 2)
    flat, safe = rho == 0.0, rho.clamp(min=1e-300)
    beta = cosine * sine * (sigma_u**2 - sigma_v**2) / safe**2
    return torch.where(flat, sigma_u, sigma_u * sigma_v / safe), rho, torch.where(flat, 0.0, beta)


def extents(sums: Sums, window: Window, sigma_x_px: float, bandwidth: float) -> tuple[Number, Number]:
    """Standard deviations of the screen-space filter along its axes, the longer first."""
    sigma_u, sigma_v, _ = axes(screen_covariance(sheared_slopes(sums, window, sigma_x_px, bandwidth), window, sigma_x_px))
    return sigma_u, sigma_v


def spread_px(sums: Sums, window: Window, sigma_x_px: float) -> tuple[Number, Number]:
    """Standard deviations of the blur of the mean sample along its axes, the longer first."""
    r, m_x, m_y = (sums[..., k] / sums[..., 0] for k in (1, 3, 4))
    sigma_u, sigma_v, _ = axes(_blur(r, m_x, m_y, window, sigma_x_px)[0])
    return sigma_u, sigma_v


def slope_distance(one: Sums, other: Sums, window: Window, sigma_x_px: float) -> Number:
    """By how much reprojection along the mean slopes of the other goes wrong for the mean sample of one, in units of its own blur."""
    r, m_x, m_y = (one[..., k] / one[..., 0] for k in (1, 3, 4))
    off_r, off_x, off_y = (other[..., k] / other[..., 0] - mean for k, mean in ((1, r), (3, m_x), (4, m_y)))
    out, det = _blur(r, m_x, m_y, window, sigma_x_px)
    lens = off_r**2 * (out.yy * window[0] - 2.0 * out.xy * window[1] + out.xx * window[2]) / (2.0 * det)
    shutter = window[3] * (out.yy * off_x**2 - 2.0 * out.xy * off_x * off_y + out.xx * off_y**2) / det
    return torch.sqrt(lens + shutter)


def _blur(r: Number, m_x: Number, m_y: Number, window: Window, sigma_x_px: float) -> tuple[Spread, Number]:
    """The blur of the mean sample (what of the spectrum passes pupil, shutter and pixel), and its determinant."""
    out = Spread(
        sigma_x_px**2 + r * r * window[0] + window[3] * m_x * m_x,
        r * r * window[1] + window[3] * m_x * m_y,
        sigma_x_px**2 + r * r * window[2] + window[3] * m_y * m_y,
    )
    return out, (out.xx * out.yy - out.xy * out.xy).clamp(min=1e-12)
