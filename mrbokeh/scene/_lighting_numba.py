"""Light on shading points: glTF's metallic-roughness BRDF under lights and under a panorama. Compiled with numba."""

from math import pi, sqrt

import numpy as np

from mrbokeh.scene._compiled_numba import compiled
from mrbokeh.scene._environment_numba import PanoramaLevels, look_up, look_up_between
from mrbokeh.scene._surface_numba import Surfaces
from mrbokeh.scene._vectors_numba import Vector, cross, dot, row, scaled, sub, unit3

LOWEST_ROUGHNESS = 0.045
"""A perfect mirror does not show a light without extent at all; this is the usual floor of real-time engines."""


@compiled
def add_emission(surfaces: Surfaces, rgb: np.ndarray) -> None:
    """What shines by itself: emissive surfaces, and unlit ones their base colour."""
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
