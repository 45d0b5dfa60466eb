"""Packed textures read by Mitsuba's compiler: bilinear with wrap modes, from the level that has about one texel per ray."""

from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from mrbokeh.scene.packed_scene import MIRROR, REPEAT, PackedTextures


class TextureTables:
    """`PackedTextures` on the device; the compiled twin is `_texture_numba`."""

    def __init__(self, textures: PackedTextures) -> None:
        self._texels = mi.Float(textures.texels.ravel())
        self._level_start = mi.UInt32(textures.level_start.astype(np.uint32))
        self._level_size = mi.UInt32(textures.level_size.astype(np.uint32).ravel())
        self._first_level = mi.UInt32(textures.first_level.astype(np.uint32))
        self._wrap = mi.UInt32(textures.wrap.astype(np.uint32).ravel())
        self._uv_set = mi.UInt32(textures.uv_set.astype(np.uint32))
        self._affine = mi.Float(textures.texture_from_uv.ravel())

    def read(self, texture: Any, uv: tuple[Any, Any], width: tuple[Any, Any], active: Any) -> Any:
        """(r, g, b, a) of textures (by number) at uv, both sets of coordinates; width: of what a ray stands for, in each set's."""
        second = dr.gather(mi.UInt32, self._uv_set, texture, active) == 1
        at, width = dr.select(second, uv[1], uv[0]), dr.select(second, width[1], width[0])
        m = [dr.gather(mi.Float, self._affine, 6 * texture + entry, active) for entry in range(6)]
        s, t = m[0] * at.x + m[1] * at.y + m[2], m[3] * at.x + m[4] * at.y + m[5]
        first, end = (dr.gather(mi.UInt32, self._first_level, texture + step, active) for step in (0, 1))
        size = dr.gather(mi.Vector2u, self._level_size, first, active)
        texels = width * dr.sqrt(mi.Float(size.x) * mi.Float(size.y) * dr.abs(m[0] * m[4] - m[1] * m[3]))
        level = dr.minimum(first + mi.UInt32(dr.log2(dr.maximum(texels, 1.0))), end - 1)
        return self._bilinear(texture, level, s, t, active)

    def _bilinear(self, texture: Any, level: Any, s: Any, t: Any, active: Any) -> Any:
        start = dr.gather(mi.UInt32, self._level_start, level, active)
        size = mi.Vector2i(dr.gather(mi.Vector2u, self._level_size, level, active))
        wrap = dr.gather(mi.Vector2u, self._wrap, texture, active)
        (left, right, x), (top, bottom, y) = _neighbours(s, size.y, wrap.x), _neighbours(t, size.x, wrap.y)
        a, b, c, d = (
            dr.gather(mi.Vector4f, self._texels, start + mi.UInt32(row * size.y + column), active)
            for row, column in ((top, left), (top, right), (bottom, left), (bottom, right))
        )
        return (1 - y) * ((1 - x) * a + x * b) + y * ((1 - x) * c + x * d)


def _neighbours(s: Any, size: Any, wrap: Any) -> tuple[Any, Any, Any]:
    """(texel before, texel after, how far between their centres) of a coordinate in [0, 1] and beyond."""
    folded = dr.abs(s - 2 * dr.round(s / 2))
    s = dr.select(wrap == REPEAT, s - dr.floor(s), dr.select(wrap == MIRROR, folded, dr.clip(s, 0.0, 1.0)))
    x = s * mi.Float(size) - 0.5
    low = mi.Int32(dr.floor(x))
    repeats = wrap == REPEAT
    before = dr.select(low < 0, dr.select(repeats, size - 1, 0), low)
    after = dr.select(low + 1 >= size, dr.select(repeats, 0, size - 1), low + 1)
    return before, after, x - dr.floor(x)
