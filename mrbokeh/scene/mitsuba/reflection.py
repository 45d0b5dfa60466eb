"""Metallic-roughness reflection of glTF for path tracing: its value, and directions drawn in proportion to it.

The compiled twin for lights without extent is `add_light` in `_lighting_numba`. Light that a rough surface's facets pass on to each
other is given back by a factor on the reflection (Turquin 2019, "Practical multiple scattering compensation for microfacet models"), so
that a white metal in uniform light shows that light. Below a reflection at most the remaining light is scattered: the specification's
own weight of the albedo would make surfaces seen at grazing angles brighter than the light around them.
"""

from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi

from mrbokeh.scene._lighting_numba import LOWEST_ROUGHNESS
from mrbokeh.scene.environment_filter import reflected_share_table
from mrbokeh.scene.mitsuba.surfaces import Surface

_RED, _GREEN, _BLUE = 0.2126, 0.7152, 0.0722


def luminance(color: Any) -> Any:
    return _RED * color.x + _GREEN * color.y + _BLUE * color.z


class ShareTable:
    """Share of uniform light that a surface reflects, by roughness and viewing angle."""

    def __init__(self) -> None:
        table = reflected_share_table()
        self._last, self._shares = len(table) - 1, mi.Float(table.ravel())

    def read(self, roughness: Any, n_v: Any) -> Any:
        """Return (factor of f0, factor of f90), bilinearly."""
        y, x = roughness * self._last, dr.clip(n_v, 0.0, 1.0) * self._last
        top, left = dr.minimum(mi.UInt32(y), self._last - 1), dr.minimum(mi.UInt32(x), self._last - 1)
        down, right, width = y - mi.Float(top), x - mi.Float(left), self._last + 1
        a, b, c, d = (dr.gather(mi.Vector2f, self._shares, top * width + left + step) for step in (0, 1, width, width + 1))
        return (1 - down) * ((1 - right) * a + right * b) + down * ((1 - right) * c + right * d)


@dataclass(frozen=True)
class Reflection:
    """A Surface ready to reflect. below: what the reflection leaves of uniform light.

    mirror_share: how often a direction is drawn from the reflection rather than from the albedo.
    """

    surface: Surface
    n_v: Any
    alpha2: Any
    gain: Any
    below: Any
    mirror_share: Any

    def value(self, towards: Any) -> tuple[Any, Any]:
        """Return (BRDF times the cosine towards the light, density with which `drawn` gives that direction per steradian)."""
        surface, n_v, alpha2 = self.surface, self.n_v, self.alpha2
        n_l = dr.dot(surface.normal, towards)
        half = dr.normalize(towards + surface.to_viewer)
        n_h, v_h = dr.dot(surface.normal, half), dr.maximum(dr.dot(surface.to_viewer, half), 0.0)
        # 1 - n_h**2 as a sine: exact near the peak, where the difference of two numbers near 1 is not.
        across = dr.cross(surface.normal, half)
        spread = dr.squared_norm(across) + alpha2 * n_h * n_h
        distribution = alpha2 * dr.inv_pi / dr.square(spread)
        masking_v, masking_l = _masked(n_v, alpha2), _masked(n_l, alpha2)
        visibility = 0.5 / (n_l * masking_v + n_v * masking_l)
        fresnel = surface.f0 + (surface.f90 - surface.f0) * (1.0 - v_h) ** 5
        brdf = dr.minimum(1.0 - fresnel, self.below) * surface.diffuse * dr.inv_pi + fresnel * self.gain * (distribution * visibility)
        # The density of visible normals (Heitz 2018) by the change of variables from half vector to direction.
        mirrored = distribution / (2.0 * (n_v + masking_v))
        density = self.mirror_share * mirrored + (1.0 - self.mirror_share) * n_l * dr.inv_pi
        above = n_l > 0.0
        return dr.select(above, brdf * n_l, 0.0), dr.select(above, density, 0.0)

    def drawn(self, which: Any, uv: Any) -> Any:
        """A direction: which, uv: uniform numbers. It may point below the surface, where the value is 0."""
        frame = mi.Frame3f(self.surface.normal)
        local = frame.to_local(self.surface.to_viewer)
        view = dr.normalize(mi.Vector3f(local.x, local.y, dr.maximum(local.z, 1e-4)))
        half = _visible_normal(view, dr.sqrt(self.alpha2), uv)
        mirrored = 2.0 * dr.dot(view, half) * half - view
        return frame.to_world(dr.select(which < self.mirror_share, mirrored, mi.warp.square_to_cosine_hemisphere(uv)))


def reflection(surface: Surface, table: ShareTable) -> Reflection:
    """Prepare a surface for any number of directions."""
    n_v = dr.maximum(dr.dot(surface.normal, surface.to_viewer), 1e-4)
    roughness = dr.maximum(surface.roughness, LOWEST_ROUGHNESS)
    share = table.read(roughness, n_v)
    gain = 1.0 + surface.f0 * (1.0 / dr.maximum(share.x + share.y, 0.05) - 1.0)
    mirrored = (surface.f0 * share.x + surface.f90 * share.y) * gain
    mirrors, below = luminance(mirrored), 1.0 - mirrored
    scatters = luminance(surface.diffuse * below)
    both = dr.maximum(mirrors + scatters, 1e-6)
    mirror_share = dr.select(mirrors > 0.0, dr.select(scatters > 0.0, dr.clip(mirrors / both, 0.1, 0.9), 1.0), 0.0)
    return Reflection(surface=surface, n_v=n_v, alpha2=roughness**4, gain=gain, below=below, mirror_share=mirror_share)


def _masked(cosine: Any, alpha2: Any) -> Any:
    return dr.sqrt(cosine * cosine * (1.0 - alpha2) + alpha2)


def _visible_normal(view: Any, alpha: Any, uv: Any) -> Any:
    """A facet's normal as often as it is seen from `view` (Heitz 2018, "Sampling the GGX Distribution of Visible Normals")."""
    stretched = dr.normalize(mi.Vector3f(alpha * view.x, alpha * view.y, view.z))
    sideways = dr.square(stretched.x) + dr.square(stretched.y)
    tangent = dr.select(
        sideways > 1e-12, mi.Vector3f(-stretched.y, stretched.x, 0.0) * dr.rsqrt(dr.maximum(sideways, 1e-12)), mi.Vector3f(1.0, 0.0, 0.0)
    )
    disk = mi.warp.square_to_uniform_disk_concentric(uv)
    share = 0.5 * (1.0 + stretched.z)
    y = dr.lerp(dr.safe_sqrt(1.0 - dr.square(disk.x)), disk.y, share)
    z = dr.safe_sqrt(1.0 - dr.square(disk.x) - dr.square(y))
    normal = disk.x * tangent + y * dr.cross(stretched, tangent) + z * stretched
    return dr.normalize(mi.Vector3f(alpha * normal.x, alpha * normal.y, dr.maximum(normal.z, 1e-6)))
