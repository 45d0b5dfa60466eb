"""An Environment as a source of light for path tracing: looked up, and drawn from in proportion to its light."""

from typing import Any

import cv2
import drjit as dr
import mitsuba as mi
import numpy as np

from mrbokeh.images.color import luminance
from mrbokeh.scene.environment import Environment, solid_angles_sr


class EnvironmentTables:
    """A panorama on the device, read bilinearly as the ray caster reads it."""

    def __init__(self, environment: Environment) -> None:
        radiance = environment.radiance
        height, width = radiance.shape[:2]
        # One more texel all around: over a pole the panorama goes on at the opposite longitude.
        beyond = np.concatenate([np.roll(radiance[:1], width // 2, 1), radiance, np.roll(radiance[-1:], width // 2, 1)])
        beyond = np.concatenate([beyond[:, -1:], beyond, beyond[:, :1]], axis=1)
        self._texels = mi.Float(np.ascontiguousarray(beyond, np.float32).ravel())
        self._height, self._width = dr.opaque(mi.UInt32, height), dr.opaque(mi.UInt32, width)
        self._world_from_self = [mi.Float(row.astype(np.float32)) for row in np.asarray(environment.world_from_environment)]
        # Between texels light is mixed: so the light around a texel, not that of the texel alone, says how often it is drawn.
        around = cv2.blur(np.ascontiguousarray(luminance(beyond.astype(np.float64))), (3, 3), borderType=cv2.BORDER_REPLICATE)[1:-1, 1:-1]
        weights = np.maximum(around, 1e-12 + 1e-6 * around.max()) * solid_angles_sr(height, width)
        self._drawing = mi.DiscreteDistribution2D((weights / weights.sum()).astype(np.float32))

    def radiance(self, direction: Any, active: Any) -> Any:
        """Light that comes from a direction (unit vectors away from the scene, in the world)."""
        column, row = self._place(direction)
        x, y = column + 0.5, row + 0.5  # half-integer centres, and the border of one texel
        left, top = mi.UInt32(x), mi.UInt32(y)
        right, down = x - mi.Float(left), y - mi.Float(top)
        stride = self._width + 2
        corner = top * stride + left
        a, b, c, d = (dr.gather(mi.Color3f, self._texels, corner + step, active) for step in (0, 1, stride, stride + 1))
        return (1 - down) * ((1 - right) * a + right * b) + down * ((1 - right) * c + right * d)

    def drawn(self, uv: Any, active: Any) -> tuple[Any, Any]:
        """(direction, density per steradian) for uniform numbers."""
        texel, share, within = self._drawing.sample(uv, active)
        longitude = (mi.Float(texel.x) + within.x) / mi.Float(self._width) * dr.two_pi - dr.pi
        upper, lower = self._borders(texel.y)
        rising = dr.lerp(upper, lower, within.y)
        level = dr.safe_sqrt(1.0 - dr.square(rising))
        sine, cosine = dr.sincos(longitude)
        own = mi.Vector3f(level * sine, -rising, level * cosine)
        turned = [own.x * self._entry(row, 0) + own.y * self._entry(row, 1) + own.z * self._entry(row, 2) for row in range(3)]
        return mi.Vector3f(*turned), self._per_steradian(share, upper, lower)

    def density(self, direction: Any, active: Any) -> Any:
        """How often `drawn` gives a direction, per steradian."""
        column, row = self._place(direction)
        texel = mi.Point2u(dr.minimum(mi.UInt32(column), self._width - 1), dr.minimum(mi.UInt32(row), self._height - 1))
        return self._per_steradian(self._drawing.pdf(texel, active), *self._borders(texel.y))

    def _borders(self, row: Any) -> tuple[Any, Any]:
        """Cosine of the polar angle at the upper and lower border of a row of the panorama."""
        return tuple(dr.cos(mi.Float(row + step) / mi.Float(self._height) * dr.pi) for step in (0, 1))  # type: ignore[return-value]

    def _per_steradian(self, share: Any, upper: Any, lower: Any) -> Any:
        return share * mi.Float(self._width) / (dr.two_pi * dr.maximum(upper - lower, 1e-12))

    def _place(self, direction: Any) -> tuple[Any, Any]:
        """Column and row of a direction."""
        own = [sum(direction[row] * self._entry(row, column) for row in range(3)) for column in range(3)]
        u, v = dr.atan2(own[0], own[2]) * dr.inv_two_pi + 0.5, dr.safe_acos(-own[1]) * dr.inv_pi
        return dr.clip(u, 0.0, 1.0) * mi.Float(self._width), dr.clip(v, 0.0, 1.0) * mi.Float(self._height)

    def _entry(self, row: int, column: int) -> Any:
        return dr.gather(mi.Float, self._world_from_self[row], mi.UInt32(column))
