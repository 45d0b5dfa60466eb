"""Reading packed textures: bilinear with wrap modes, trilinear over coarser levels. Compiled with numba."""

from math import floor, log2, sqrt

import numpy as np

from mrbokeh.scene._compiled_numba import compiled
from mrbokeh.scene.packed_scene import CLAMP, MIRROR, PackedTextures

Texel = tuple[float, float, float, float]


@compiled
def _wrapped(index: int, size: int, wrap: int) -> int:
    if 0 <= index < size:
        return index  # by far most often, and a division costs as much as the rest of a lookup
    if wrap == CLAMP:
        return min(max(index, 0), size - 1)
    if wrap == MIRROR:
        index = index % (2 * size)
        return index if index < size else 2 * size - 1 - index
    return index % size


@compiled
def _bilinear(textures: PackedTextures, texture: int, level: int, s: float, t: float) -> Texel:
    """One level of a texture at (s, t) in [0, 1]; texel centres lie at half-integers."""
    height, width = textures.level_size[level, 0], textures.level_size[level, 1]
    start = textures.level_start[level]
    wrap_s, wrap_t = textures.wrap[texture, 0], textures.wrap[texture, 1]
    x, y = s * width - 0.5, t * height - 0.5
    x_low, y_low = floor(x), floor(y)
    right, down = x - x_low, y - y_low
    x0, x1 = _wrapped(x_low, width, wrap_s), _wrapped(x_low + 1, width, wrap_s)
    y0, y1 = _wrapped(y_low, height, wrap_t), _wrapped(y_low + 1, height, wrap_t)
    # Unsigned, so that no index is tried for being negative.
    a, b = np.uintp(start + y0 * width + x0), np.uintp(start + y0 * width + x1)
    c, d = np.uintp(start + y1 * width + x0), np.uintp(start + y1 * width + x1)
    w_a, w_b, w_c, w_d = (1 - right) * (1 - down), right * (1 - down), (1 - right) * down, right * down
    v = textures.texels
    return (
        w_a * v[a, 0] + w_b * v[b, 0] + w_c * v[c, 0] + w_d * v[d, 0],
        w_a * v[a, 1] + w_b * v[b, 1] + w_c * v[c, 1] + w_d * v[d, 1],
        w_a * v[a, 2] + w_b * v[b, 2] + w_c * v[c, 2] + w_d * v[d, 2],
        w_a * v[a, 3] + w_b * v[b, 3] + w_c * v[c, 3] + w_d * v[d, 3],
    )


@compiled
def read_texture(textures: PackedTextures, texture: int, uv: Texel, footprint: tuple[float, float]) -> Texel:
    """A texture at uv (two sets of coordinates) where it has about one texel per ray.

    footprint: width of what the ray stands for, in each set's coordinates.
    """
    uv_set = textures.uv_set[texture]
    u, v = uv[2 * uv_set], uv[2 * uv_set + 1]
    m = textures.texture_from_uv
    s = m[texture, 0, 0] * u + m[texture, 0, 1] * v + m[texture, 0, 2]
    t = m[texture, 1, 0] * u + m[texture, 1, 1] * v + m[texture, 1, 2]
    stretch = abs(m[texture, 0, 0] * m[texture, 1, 1] - m[texture, 0, 1] * m[texture, 1, 0])
    first, end = textures.first_level[texture], textures.first_level[texture + 1]
    detail = footprint[uv_set] * sqrt(float(textures.level_size[first, 0]) * textures.level_size[first, 1] * stretch)
    if detail <= 1.0:
        return _bilinear(textures, texture, first, s, t)
    level = min(log2(detail), float(end - first - 1))
    low = int(level)
    fine = _bilinear(textures, texture, first + low, s, t)
    coarse = _bilinear(textures, texture, min(first + low + 1, end - 1), s, t)
    f = level - low
    return (
        fine[0] + f * (coarse[0] - fine[0]),
        fine[1] + f * (coarse[1] - fine[1]),
        fine[2] + f * (coarse[2] - fine[2]),
        fine[3] + f * (coarse[3] - fine[3]),
    )
