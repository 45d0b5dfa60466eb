"""What a ray sees, on Dr.Jit's LLVM back end: texture times light, with the sun's shadows; the same from every direction."""

from typing import Any

import drjit as dr
import numpy as np

from datasets_scripts.truth_scene import FACET_COLUMNS, PackedScene
from datasets_scripts.truth_tracer import SHADOW_GAP_M


class LlvmShading:
    """Tables of a scene on the device. everything: Mitsuba's scene that throws the shadows; first_triangle: of the part looked at."""

    def __init__(self, mi: Any, scene: PackedScene, everything: Any, first_triangle: int, sky: bool) -> None:
        self._mi, self._everything, self._first = mi, everything, first_triangle
        self._sky_texture = scene.sky_texture if sky and scene.sky_texture[1] else None
        self._towards_sun = mi.Vector3f(*scene.towards_sun.tolist())
        self._facets, self._texels = mi.Float(scene.facets.ravel()), mi.Float(scene.texels.ravel())
        self._textures = mi.UInt32(scene.facet_texture.ravel().astype(np.uint32))
        self._normals = mi.Float(scene.facet_normals.ravel())

    def seen(self, hit: Any, ray: Any) -> tuple[Any, Any, Any]:
        """(radiance, 1 where a body or the sky is seen, 1 / depth) for Mitsuba's preliminary intersection of a ray."""
        mi, found = self._mi, hit.is_valid()
        radiance, covered = dr.select(found, self._lit_surface(hit, ray, found), 0.0), dr.select(found, mi.Float(1.0), 0.0)
        if self._sky_texture is not None:
            uv = mi.Point2f(0.5 + 0.5 * ray.d.x / ray.d.z, 0.5 + 0.5 * ray.d.y / ray.d.z)
            radiance, covered = (
                dr.select(found, radiance, self._texel(uv, [mi.UInt32(each) for each in self._sky_texture], ~found)),
                mi.Float(1.0),
            )
        return radiance, covered, dr.select(found, 1.0 / (hit.t * ray.d.z), 0.0)

    def _lit_surface(self, hit: Any, ray: Any, found: Any) -> Any:
        mi, facet = self._mi, hit.prim_index + self._first
        b1, b2 = hit.prim_uv.x, hit.prim_uv.y
        b0 = 1.0 - b1 - b2
        row = [dr.gather(mi.Float, self._facets, FACET_COLUMNS * facet + column, found) for column in range(FACET_COLUMNS)]
        uv = mi.Point2f(b0 * row[0] + b1 * row[2] + b2 * row[4], b0 * row[1] + b1 * row[3] + b2 * row[5])
        sun, sky = b0 * row[6] + b1 * row[7] + b2 * row[8], b0 * row[9] + b1 * row[10] + b2 * row[11]
        texture = [dr.gather(mi.UInt32, self._textures, 3 * facet + column, found) for column in range(3)]
        normal = dr.gather(mi.Vector3f, self._normals, facet, found)
        sunny = found & (sun > 0.0)
        sunny &= ~self._everything.ray_test(mi.Ray3f(ray(hit.t) + normal * SHADOW_GAP_M, self._towards_sun), sunny)
        return self._texel(uv, texture, found) * row[12] * (sky + dr.select(sunny, sun, 0.0))

    def _texel(self, uv: Any, texture: list[Any], active: Any) -> Any:
        """Bilinear between texel centres, repeating; texture: start, width, height."""
        mi, (start, width, height) = self._mi, texture
        x = (uv.x - dr.floor(uv.x)) * mi.Float(width) - 0.5
        y = (uv.y - dr.floor(uv.y)) * mi.Float(height) - 0.5
        left, top = mi.Int32(dr.floor(x)), mi.Int32(dr.floor(y))
        w, h = mi.Int32(width), mi.Int32(height)
        columns = ((dr.select(left < 0, w - 1, left), 1.0 - x + dr.floor(x)), (dr.select(left + 1 >= w, 0, left + 1), x - dr.floor(x)))
        rows = ((dr.select(top < 0, h - 1, top), 1.0 - y + dr.floor(y)), (dr.select(top + 1 >= h, 0, top + 1), y - dr.floor(y)))
        result = mi.Color3f(0.0)
        for row, share_y in rows:
            for column, share_x in columns:
                result += share_x * share_y * dr.gather(mi.Color3f, self._texels, start + mi.UInt32(row * w + column), active)
        return result
