"""The screen-space Gaussian by anisotropic look-ups in a mip map, as texture units of graphics processors do (Eq. 2 to 4)."""

import math

import numpy as np

from mrbokeh.system.kernels import njit

_MOST_PROBES = 16


@njit(cache=True, nogil=True)
def mip_map(planes: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """All levels, each the mean of 2x2 of the one below (nothing beyond the border), in one flat array, with (start, h, w) of each."""
    height, width, channels = planes.shape
    levels, total = 1, height * width
    h, w = height, width
    while h > 1 or w > 1:
        h, w = (h + 1) // 2, (w + 1) // 2
        levels, total = levels + 1, total + h * w
    flat, places = np.zeros((total, channels), np.float32), np.zeros((levels, 3), np.int64)
    places[0, 1], places[0, 2] = height, width
    for y in range(height):
        for x in range(width):
            for c in range(channels):
                flat[y * width + x, c] = planes[y, x, c]
    for level in range(1, levels):
        below, h, w = places[level - 1, 0], places[level - 1, 1], places[level - 1, 2]
        start, half_h, half_w = below + h * w, (h + 1) // 2, (w + 1) // 2
        places[level, 0], places[level, 1], places[level, 2] = start, half_h, half_w
        for y in range(h):
            for x in range(w):
                for c in range(channels):
                    flat[start + (y // 2) * half_w + x // 2, c] += np.float32(0.25) * flat[below + y * w + x, c]
    return flat, places


@njit(cache=True, nogil=True)
def _add_bilinear(total: np.ndarray, flat: np.ndarray, place: np.ndarray, x: float, y: float, weight: float) -> None:
    """Add the level at texel coordinates (x, y), with centres at whole numbers."""
    start, height, width = place[0], place[1], place[2]
    column, row = int(math.floor(x)), int(math.floor(y))
    for j in range(2):
        for i in range(2):
            at_x, at_y = column + i, row + j
            if 0 <= at_x < width and 0 <= at_y < height:
                share = weight * (1.0 - abs(x - at_x)) * (1.0 - abs(y - at_y))
                for c in range(flat.shape[1]):
                    total[c] += share * flat[start + at_y * width + at_x, c]


@njit(cache=True, nogil=True)
def add_look_up(
    total: np.ndarray,
    flat: np.ndarray,
    places: np.ndarray,
    x: float,
    y: float,
    major_x: float,
    major_y: float,
    minor_px: float,
    weight: float,
) -> None:
    """One anisotropic look-up at the place (x, y) in pixels: trilinear probes side by side along the major axis.

    (major_x, major_y), minor_px: the footprint's axes as the derivatives ddx, ddy give them; at most 16 probes.
    One probe of a texel's width w has the variance w^2 / 4 (a box and the tent of the interpolation), so that a round footprint
    of the width ddx has ddx^2 / 4. The probes of a long one are weighted by a Gaussian (Heckbert's EWA) that gives it the same
    along its major axis; equal weights over the length ddx would give a third of it.
    """
    major_px = math.hypot(major_x, major_y)
    least = max(minor_px, 1.0)
    probes = min(_MOST_PROBES, max(1, int(math.ceil(2.0 * (major_px - least) / least - 1e-6))))
    texel_px = max(2.0 * major_px / (probes + 2.0), least) if probes == _MOST_PROBES else least
    level = min(max(math.log2(texel_px), 0.0), len(places) - 1.0)
    below = min(int(level), len(places) - 1)
    above, part_above = min(below + 1, len(places) - 1), level - below
    rest = max(0.25 * (major_px * major_px - texel_px * texel_px), 1e-6)
    gain = 0.0
    for probe in range(probes):
        gain += math.exp(-0.5 * (major_px * ((2.0 * probe + 1.0) / probes - 1.0)) ** 2 / rest)
    for probe in range(probes):
        along = (2.0 * probe + 1.0) / probes - 1.0
        at_x, at_y = x + along * major_x, y + along * major_y
        share = weight * math.exp(-0.5 * (along * major_px) ** 2 / rest) / gain
        for which, part in ((below, 1.0 - part_above), (above, part_above)):
            if part > 0.0:
                texel = 2.0**which
                _add_bilinear(total, flat, places[which], at_x / texel - 0.5, at_y / texel - 0.5, share * part)


@njit(cache=True, nogil=True)
def texture_gaussian(
    out: np.ndarray,
    planes: np.ndarray,
    guard_x: int,
    guard_y: int,
    sigma_u: float,
    sigma_v: float,
    theta: float,
    alpha: float,
    tap_distance: float,
    taps: int,
) -> None:
    """As direct_gaussian. taps: 1, or 4 of a footprint smaller by tap_distance, that far from the centre along both axes (Fig. 4)."""
    flat, places = mip_map(planes)
    cosine, sine = math.cos(theta), math.sin(theta)
    u_px, v_px = alpha * sigma_u, alpha * sigma_v
    size = 1.0
    if taps == 4:
        # A look-up of the width w has the variance w^2 / 4: with the taps' distance that makes less than sigma^2, made good here.
        size = 1.0 - tap_distance
        widening = 1.0 / (alpha * math.sqrt(0.25 * size * size + 0.5 * tap_distance * tap_distance))
        u_px, v_px = widening * u_px, widening * v_px
    height, width, channels = out.shape
    total = np.zeros(channels)
    for y in range(height):
        for x in range(width):
            total[:] = 0.0
            centre_x, centre_y = x + guard_x + 0.5, y + guard_y + 0.5
            for tap in range(taps):
                along_u = along_v = 0.0
                if taps == 4:
                    along_u = tap_distance * u_px * (1.0 if tap == 0 else -1.0 if tap == 1 else 0.0)
                    along_v = tap_distance * v_px * (1.0 if tap == 2 else -1.0 if tap == 3 else 0.0)
                at_x, at_y = centre_x + cosine * along_u - sine * along_v, centre_y + sine * along_u + cosine * along_v
                add_look_up(total, flat, places, at_x, at_y, size * u_px * cosine, size * u_px * sine, size * v_px, 1.0 / taps)
            for c in range(channels):
                out[y, x, c] = total[c]
