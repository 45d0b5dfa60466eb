"""Image-based lighting and glTF's metallic-roughness BRDF, compiled with numba.

Panoramas are filtered by cosine and GGX convolution; shading points are lit by lights and by the filtered panorama.
"""

from math import acos, atan2, cos, log2, pi, sin, sqrt
from typing import NamedTuple

import numpy as np

from mrbokeh.scene._surface_numba import Surfaces
from mrbokeh.scene._vectors_numba import Vector, compiled, cross, dot, row, scaled, sub, unit3

LOWEST_ROUGHNESS = 0.045
"""A perfect mirror does not show a light without extent at all; this is the usual floor of real-time engines."""


class PanoramaLevels(NamedTuple):
    """Panoramas of several sizes, one after the other; texel centres at half-integers, as in `Environment`."""

    radiance: np.ndarray  # (N, 3) float32
    start: np.ndarray  # (L,) int32
    size: np.ndarray  # (L, 2) int32 height, width


@compiled
def _index(x: int, y: int, height: int, width: int) -> int:
    """Texel index; over a pole the panorama goes on at the opposite longitude."""
    if y < 0:
        y, x = -1 - y, x + width // 2
    elif y >= height:
        y, x = 2 * height - 1 - y, x + width // 2
    return y * width + x % width


@compiled
def look_up(levels: PanoramaLevels, level: int, x: float, y: float, z: float) -> Vector:
    """Radiance from the unit direction (x, y, z), bilinearly."""
    u, v = _place(x, y, z)
    return _bilinear(levels, level, u, v)


@compiled
def _place(x: float, y: float, z: float) -> tuple[float, float]:
    """Column and row of a direction as shares of the panorama's width and height."""
    return atan2(x, z) / (2 * pi) + 0.5, acos(min(max(-y, -1.0), 1.0)) / pi


@compiled
def _bilinear(levels: PanoramaLevels, level: int, u: float, v: float) -> Vector:
    height, width = levels.size[level, 0], levels.size[level, 1]
    start = levels.start[level]
    column, row = u * width - 0.5, v * height - 0.5
    left, top = int(np.floor(column)), int(np.floor(row))
    right, down = column - left, row - top
    if left >= 0 and left + 1 < width and top >= 0 and top + 1 < height:
        a = start + top * width + left
        b, c, d = a + 1, a + width, a + width + 1
    else:
        a, b = start + _index(left, top, height, width), start + _index(left + 1, top, height, width)
        c, d = start + _index(left, top + 1, height, width), start + _index(left + 1, top + 1, height, width)
    w_a, w_b, w_c, w_d = (1 - right) * (1 - down), right * (1 - down), (1 - right) * down, right * down
    values = levels.radiance
    i, j, k, m = np.uintp(a), np.uintp(b), np.uintp(c), np.uintp(d)  # unsigned: no index is tried for being negative
    return (
        w_a * values[i, 0] + w_b * values[j, 0] + w_c * values[k, 0] + w_d * values[m, 0],
        w_a * values[i, 1] + w_b * values[j, 1] + w_c * values[k, 1] + w_d * values[m, 1],
        w_a * values[i, 2] + w_b * values[j, 2] + w_c * values[k, 2] + w_d * values[m, 2],
    )


@compiled
def look_up_between(levels: PanoramaLevels, level: float, x: float, y: float, z: float) -> Vector:
    """Radiance between two neighbouring levels (level is fractional)."""
    level = min(max(level, 0.0), levels.start.size - 1.0)
    low = int(level)
    fraction = level - low
    u, v = _place(x, y, z)
    fine = _bilinear(levels, low, u, v)
    if fraction == 0.0:
        return fine
    coarse = _bilinear(levels, low + 1, u, v)
    return (
        fine[0] + fraction * (coarse[0] - fine[0]),
        fine[1] + fraction * (coarse[1] - fine[1]),
        fine[2] + fraction * (coarse[2] - fine[2]),
    )


@compiled
def cosine_convolved(moments: np.ndarray, normals: np.ndarray, out: np.ndarray) -> None:
    """Irradiance / pi for each normal: sum over blocks of the panorama of max(0, normal . moment) / pi.

    moments: (B, 3 colours, 3) integral of radiance times direction over each block. For a block wholly above or below the
    horizon the sum is exact however its light is distributed; only the blocks that the horizon cuts are approximated.
    """
    for i in range(normals.shape[0]):
        x, y, z = normals[i, 0], normals[i, 1], normals[i, 2]
        for channel in range(3):
            total = 0.0
            for block in range(moments.shape[0]):
                cosine = x * moments[block, channel, 0] + y * moments[block, channel, 1] + z * moments[block, channel, 2]
                total += max(cosine, 0.0)
            out[i, channel] = total / pi


@compiled
def _radical_inverse(i: int) -> float:
    """Van der Corput's sequence: the second coordinate of Hammersley points."""
    result, digit = 0.0, 0.5
    while i > 0:
        result += digit * (i & 1)
        i >>= 1
        digit *= 0.5
    return result


@compiled
def ggx_lobe(roughness: float, texel_sr: float, samples: int, lobe: np.ndarray) -> None:
    """Directions around a mirrored ray in which a rough mirror looks, with normal = view = reflection.

    lobe: (samples, 4), written: across and along the tangent plane, cosine (0 or less: not seen), level of the panorama about as
    coarse as the sample's share of the sphere. texel_sr: solid angle of a texel of level 0.
    """
    alpha2 = max(roughness, 1e-3) ** 4
    for k in range(samples):
        u, phi = (k + 0.5) / samples, 2 * pi * _radical_inverse(k)
        cos2 = (1.0 - u) / (1.0 + (alpha2 - 1.0) * u)
        n_l = 2.0 * cos2 - 1.0
        sin_l = sqrt(max(1.0 - n_l * n_l, 0.0))
        density = alpha2 / (pi * (cos2 * (alpha2 - 1.0) + 1.0) ** 2) / 4.0
        lobe[k, 0], lobe[k, 1], lobe[k, 2] = sin_l * cos(phi), sin_l * sin(phi), n_l
        lobe[k, 3] = 0.5 * log2(1.0 / (samples * density * texel_sr)) + 0.5


@compiled
def ggx_convolved(source: PanoramaLevels, directions: np.ndarray, lobe: np.ndarray, out: np.ndarray) -> None:
    """The panorama as a rough mirror sees it, with normal = view = reflection (Karis 2013, "Real Shading in Unreal Engine 4").

    lobe: of `ggx_lobe`. Each sample reads a level about as coarse as its share of the sphere (filtered importance sampling: Krivanek
    and Colbert 2008), so that a small bright sun gives no noise.
    """
    for i in range(directions.shape[0]):
        rx, ry, rz = directions[i, 0], directions[i, 1], directions[i, 2]
        # A frame around the reflection (Duff et al. 2017).
        sign = 1.0 if rz >= 0 else -1.0
        a = -1.0 / (sign + rz)
        b = rx * ry * a
        tx, ty, tz = 1.0 + sign * rx * rx * a, sign * b, -sign * rx
        bx, by, bz = b, sign + ry * ry * a, -ry
        # Turned by a different angle per texel, the pattern's own shape does not show.
        turn = 2 * pi * _radical_inverse(i * 7 + 1)
        cosine, sine = cos(turn), sin(turn)
        red, green, blue, weight = 0.0, 0.0, 0.0, 0.0
        for k in range(lobe.shape[0]):
            n_l = lobe[k, 2]
            if n_l <= 0.0:
                continue
            across, along = cosine * lobe[k, 0] - sine * lobe[k, 1], sine * lobe[k, 0] + cosine * lobe[k, 1]
            x, y, z = across * tx + along * bx + n_l * rx, across * ty + along * by + n_l * ry, across * tz + along * bz + n_l * rz
            light = look_up_between(source, lobe[k, 3], x, y, z)
            red, green, blue, weight = red + n_l * light[0], green + n_l * light[1], blue + n_l * light[2], weight + n_l
        out[i, 0], out[i, 1], out[i, 2] = red / weight, green / weight, blue / weight


@compiled
def brdf_integral(size: int, samples: int, out: np.ndarray) -> None:
    """Fill (size, size, 2): reflected share of uniform light = f0 * [..., 0] + f90 * [..., 1]; rows roughness, columns cosine.

    The BRDF is the specification's: GGX, height-correlated Smith visibility, Schlick's Fresnel (glTF 2.0, appendix B).
    """
    for line in range(size):
        alpha2 = max(line / (size - 1), 1e-3) ** 4
        for column in range(size):
            n_v = max(column / (size - 1), 1e-3)
            vx = sqrt(1.0 - n_v * n_v)
            first, second = 0.0, 0.0
            for k in range(samples):
                u, phi = (k + 0.5) / samples, 2 * pi * _radical_inverse(k)
                n_h = sqrt((1.0 - u) / (1.0 + (alpha2 - 1.0) * u))
                v_h = vx * sqrt(max(1.0 - n_h * n_h, 0.0)) * cos(phi) + n_v * n_h
                n_l = 2.0 * v_h * n_h - n_v
                if n_l <= 0.0 or v_h <= 0.0:
                    continue
                visibility = 0.5 / (n_l * sqrt(n_v * n_v * (1 - alpha2) + alpha2) + n_v * sqrt(n_l * n_l * (1 - alpha2) + alpha2))
                share = visibility * n_l * 4.0 * v_h / n_h
                fresnel = (1.0 - v_h) ** 5
                first, second = first + (1.0 - fresnel) * share, second + fresnel * share
            out[line, column, 0], out[line, column, 1] = first / samples, second / samples


@compiled
def add_emission(surfaces: Surfaces, rgb: np.ndarray) -> None:
    """Add the light of emissive surfaces, and the base colour of unlit ones."""
    for i in range(surfaces.alpha.size):
        if surfaces.alpha[i] > 0.0:
            for k in range(3):
                rgb[i, k] += surfaces.base[i, k] if surfaces.roughness[i] < 0.0 else surfaces.emissive[i, k]


@compiled
def add_light(surfaces: Surfaces, towards: np.ndarray, irradiance: np.ndarray, rgb: np.ndarray) -> None:
    """Radiance reflected from one light (glTF 2.0, appendix B.3); irradiance is what arrives facing it, shadows included."""
    for i in range(surfaces.alpha.size):
        normal, light, view = row(surfaces.normal, i), row(towards, i), row(surfaces.to_viewer, i)
        n_l = dot(normal, light)
        if surfaces.alpha[i] == 0.0 or surfaces.roughness[i] < 0.0 or n_l <= 0.0:
            continue
        half = unit3((light[0] + view[0], light[1] + view[1], light[2] + view[2]))
        n_v, n_h, v_h = max(dot(normal, view), 1e-4), dot(normal, half), max(dot(view, half), 0.0)
        roughness = max(surfaces.roughness[i], LOWEST_ROUGHNESS)
        alpha2 = roughness**4
        # 1 - n_h**2 as a sine: exact near the peak, where the difference of two numbers near 1 is not.
        across = cross(normal, half)
        spread = dot(across, across) + alpha2 * n_h * n_h
        distribution = alpha2 / (pi * spread * spread)
        visibility = 0.5 / (n_l * sqrt(n_v * n_v * (1 - alpha2) + alpha2) + n_v * sqrt(n_l * n_l * (1 - alpha2) + alpha2))
        grazing = (1.0 - v_h) ** 5
        for k in range(3):
            fresnel = surfaces.f0[i, k] + (surfaces.f90[i] - surfaces.f0[i, k]) * grazing
            brdf = (1.0 - fresnel) * surfaces.diffuse[i, k] / pi + fresnel * distribution * visibility
            rgb[i, k] += brdf * n_l * irradiance[i, k]


@compiled
def _turned(matrix: np.ndarray, a: Vector) -> Vector:
    return (
        matrix[0, 0] * a[0] + matrix[0, 1] * a[1] + matrix[0, 2] * a[2],
        matrix[1, 0] * a[0] + matrix[1, 1] * a[1] + matrix[1, 2] * a[2],
        matrix[2, 0] * a[0] + matrix[2, 1] * a[1] + matrix[2, 2] * a[2],
    )


@compiled
def _reflected_share(table: np.ndarray, roughness: float, n_v: float) -> tuple[float, float]:
    """The two columns of `brdf_integral`, bilinearly."""
    last = table.shape[0] - 1
    y, x = roughness * last, min(max(n_v, 0.0), 1.0) * last
    y0, x0 = min(int(y), last - 1), min(int(x), last - 1)
    down, right = y - y0, x - x0
    first = (1 - down) * ((1 - right) * table[y0, x0, 0] + right * table[y0, x0 + 1, 0])
    first += down * ((1 - right) * table[y0 + 1, x0, 0] + right * table[y0 + 1, x0 + 1, 0])
    second = (1 - down) * ((1 - right) * table[y0, x0, 1] + right * table[y0, x0 + 1, 1])
    second += down * ((1 - right) * table[y0 + 1, x0, 1] + right * table[y0 + 1, x0 + 1, 1])
    return first, second


@compiled
def add_environment(
    surfaces: Surfaces,
    peaks: np.ndarray,
    irradiance: PanoramaLevels,
    reflections: PanoramaLevels,
    table: np.ndarray,
    environment_from_world: np.ndarray,
    rgb: np.ndarray,
) -> None:
    """Radiance reflected from the panorama: split sum (Karis 2013) with the light between microfacets given back
    (Fdez-Aguera 2019, "A Multiple-Scattering Microfacet Model for Real-Time Image-based Lighting").

    A white surface in uniform light of 1 shows 1 at every roughness and metalness. Objects do not shade each other here
    beyond their occlusion texture.
    """
    last_level = reflections.start.size - 1
    for i in range(surfaces.alpha.size):
        if surfaces.alpha[i] == 0.0 or surfaces.roughness[i] < 0.0:
            continue
        normal, view, _smooth = row(surfaces.normal, i), row(surfaces.to_viewer, i), row(surfaces.smooth_normal, i)
        n_v = max(dot(normal, view), 0.0)
        mirrored = unit3(sub(scaled(normal, 2.0 * n_v), view))
        around, mirrored = _turned(environment_from_world, normal), _turned(environment_from_world, mirrored)
        diffuse_light = look_up(irradiance, 0, *around)
        roughness = float(surfaces.roughness[i])
        level = roughness ** (2.0 / 3.0) * last_level
        mirror_light = look_up_between(reflections, level, *mirrored)
        share_f0, share_f90 = _reflected_share(table, roughness, n_v)
        missing = 1.0 - share_f0 - share_f90
        for k in range(3):
            matte_light = diffuse_light[k]
            for p in range(peaks.shape[0]):
                matte_light += max(around[0] * peaks[p, k, 0] + around[1] * peaks[p, k, 1] + around[2] * peaks[p, k, 2], 0.0)
            f0, f90 = surfaces.f0[i, k], surfaces.f90[i]
            single = f0 * share_f0 + f90 * share_f90
            average = f0 + (f90 - f0) / 21.0
            multiple = missing * single * average / (1.0 - average * missing)
            matte = surfaces.diffuse[i, k] * (1.0 - single - multiple)
            reflected = single * mirror_light[k] + (multiple + matte) * matte_light
            rgb[i, k] += reflected * surfaces.occlusion[i]
