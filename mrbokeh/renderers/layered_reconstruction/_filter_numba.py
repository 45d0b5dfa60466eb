"""The sheared filter of a partition from the sums over its samples; docs/layered_reconstruction.md derives every line."""

import math

import numpy as np

from mrbokeh.system.kernels import njit

SUMS = 8
"""Columns of a row of sums: count, r, r^2, m_x, m_y, m_x^2, m_x m_y, m_y^2, with r half the signed circle of confusion."""

WINDOW = 4
"""Second moments of the pupil (uu, uv, vv) and of the shutter (tt)."""

PIXEL_VARIANCE = 1.0 / 12.0
"""What a pixel as a bin adds to the spread of the samples in it: the variance of a box of 1 px."""


@njit(cache=True, nogil=True)
def sheared_slopes(sums: np.ndarray, window: np.ndarray, sigma_x_px: float, bandwidth: float) -> tuple[float, float, float, float, float]:
    """(r, m_x, m_y, kappa_u, kappa_t): the mean slopes of a partition and the shares of them that the filter is sheared by."""
    n = sums[0]
    r, m_x, m_y = sums[1] / n, sums[3] / n, sums[4] / n
    var_r = max(sums[2] / n - r * r, 0.0)
    var_xx, var_xy, var_yy = max(sums[5] / n - m_x * m_x, 0.0), sums[6] / n - m_x * m_y, max(sums[7] / n - m_y * m_y, 0.0)
    d_uu, d_uv, d_vv, d_tt = window[0], window[1], window[2], window[3]
    # The blur of the mean sample: what of the spectrum passes pupil, shutter and pixel.
    out_xx = sigma_x_px**2 + r * r * d_uu + d_tt * m_x * m_x
    out_xy = r * r * d_uv + d_tt * m_x * m_y
    out_yy = sigma_x_px**2 + r * r * d_vv + d_tt * m_y * m_y
    det = max(out_xx * out_yy - out_xy * out_xy, 1e-12)
    # How far the slopes of single samples leave the mean one, within that band: trace and determinant of V^-1 D.
    half = 0.5 * (out_yy * d_uu - 2.0 * out_xy * d_uv + out_xx * d_vv) / det
    largest = half + math.sqrt(max(half * half - (d_uu * d_vv - d_uv * d_uv) / det, 0.0))
    trace_m = (out_yy * var_xx - 2.0 * out_xy * var_xy + out_xx * var_yy) / det
    kappa_u = 1.0 / (1.0 + bandwidth**2 * var_r * largest)
    kappa_t = 1.0 / (1.0 + bandwidth**2 * d_tt * trace_m)
    return r, m_x, m_y, kappa_u, kappa_t


@njit(cache=True, nogil=True)
def sheared_filter(
    sums: np.ndarray, window: np.ndarray, sigma_x_px: float, bandwidth: float
) -> tuple[float, float, float, float, float, float]:
    """(a, b_x, b_y, V_xx, V_xy, V_yy): reprojection x' = x - a (u, v) - b (t - 1/2), then a Gaussian of covariance V."""
    r, m_x, m_y, kappa_u, kappa_t = sheared_slopes(sums, window, sigma_x_px, bandwidth)
    lens, shutter = kappa_u * (2.0 - kappa_u) * r * r, kappa_t * (2.0 - kappa_t) * window[3]
    v_xx = sigma_x_px**2 + lens * window[0] + shutter * m_x * m_x
    v_xy = lens * window[1] + shutter * m_x * m_y
    v_yy = sigma_x_px**2 + lens * window[2] + shutter * m_y * m_y
    return kappa_u * r, kappa_t * m_x, kappa_t * m_y, v_xx, v_xy, v_yy


@njit(cache=True, nogil=True)
def axes(v_xx: float, v_xy: float, v_yy: float) -> tuple[float, float, float]:
    """(sigma_u, sigma_v, theta) with sigma_u >= sigma_v and theta the angle of the u axis from x towards y."""
    middle, half = 0.5 * (v_xx + v_yy), math.hypot(0.5 * (v_xx - v_yy), v_xy)
    return math.sqrt(middle + half), math.sqrt(max(middle - half, 0.0)), 0.5 * math.atan2(2.0 * v_xy, v_xx - v_yy)


@njit(cache=True, nogil=True)
def sheared_axes(sigma_u: float, sigma_v: float, theta: float) -> tuple[float, float, float]:
    """(s_u, s_v, beta) of Eq. 9: the same Gaussian as one along x after one along (beta, 1)."""
    cosine, sine = math.cos(theta), math.sin(theta)
    rho = math.sqrt((sigma_v * cosine) ** 2 + (sigma_u * sine) ** 2)
    if rho == 0.0:
        return sigma_u, 0.0, 0.0
    return sigma_u * sigma_v / rho, rho, cosine * sine * (sigma_u**2 - sigma_v**2) / rho**2


@njit(cache=True, nogil=True)
def extents(sums: np.ndarray, window: np.ndarray, sigma_x_px: float, bandwidth: float) -> tuple[float, float]:
    """Standard deviations of the screen-space filter along its axes, the longer first."""
    _, _, _, v_xx, v_xy, v_yy = sheared_filter(sums, window, sigma_x_px, bandwidth)
    sigma_u, sigma_v, _ = axes(v_xx, v_xy, v_yy)
    return sigma_u, sigma_v


@njit(cache=True, nogil=True)
def spread_px(sums: np.ndarray, window: np.ndarray, sigma_x_px: float) -> tuple[float, float]:
    """Standard deviations of the blur of the mean sample along its axes, the longer first."""
    r, m_x, m_y = sums[1] / sums[0], sums[3] / sums[0], sums[4] / sums[0]
    out_xx = sigma_x_px**2 + r * r * window[0] + window[3] * m_x * m_x
    out_xy = r * r * window[1] + window[3] * m_x * m_y
    out_yy = sigma_x_px**2 + r * r * window[2] + window[3] * m_y * m_y
    sigma_u, sigma_v, _ = axes(out_xx, out_xy, out_yy)
    return sigma_u, sigma_v


@njit(cache=True, nogil=True)
def slope_distance(one: np.ndarray, other: np.ndarray, window: np.ndarray, sigma_x_px: float) -> float:
    """By how much reprojection along the mean slopes of the other goes wrong for the mean sample of one, in units of its own blur."""
    r, m_x, m_y = one[1] / one[0], one[3] / one[0], one[4] / one[0]
    off_r, off_x, off_y = other[1] / other[0] - r, other[3] / other[0] - m_x, other[4] / other[0] - m_y
    out_xx = sigma_x_px**2 + r * r * window[0] + window[3] * m_x * m_x
    out_xy = r * r * window[1] + window[3] * m_x * m_y
    out_yy = sigma_x_px**2 + r * r * window[2] + window[3] * m_y * m_y
    det = max(out_xx * out_yy - out_xy * out_xy, 1e-12)
    lens = off_r**2 * (out_yy * window[0] - 2.0 * out_xy * window[1] + out_xx * window[2]) / (2.0 * det)
    shutter = window[3] * (out_yy * off_x**2 - 2.0 * out_xy * off_x * off_y + out_xx * off_y**2) / det
    return math.sqrt(lens + shutter)
