"""Light: directional, point and spot lights as KHR_lights_punctual defines them."""

from dataclasses import dataclass, replace
from math import cos, inf, pi
from typing import Literal

import numpy as np
from jaxtyping import Float

from mrbokeh.scene.material import Triple
from mrbokeh.system.errors import InputError

LightKind = Literal["directional", "point", "spot"]


@dataclass(frozen=True)
class Light:
    """A light without extent.

    rgb: linear strength. Directional: irradiance on a surface facing the light (a white Lambertian surface then shows
        rgb / pi). Point and spot: radiant intensity, whose irradiance is rgb / distance**2 (metres).
    position_m, direction: in world space; direction is the unit vector along which the light travels.
    range_m: beyond it a point or spot light is cut off smoothly.
    inner_cone_rad, outer_cone_rad: half angles between which a spot fades out.
    """

    kind: LightKind
    rgb: Triple
    position_m: Triple = (0.0, 0.0, 0.0)
    direction: Triple = (0.0, 1.0, 0.0)
    range_m: float = inf
    inner_cone_rad: float = 0.0
    outer_cone_rad: float = pi / 4
    casts_shadow: bool = True

    def __post_init__(self) -> None:
        if not 0.0 <= self.inner_cone_rad <= self.outer_cone_rad <= pi / 2 or self.range_m <= 0:
            raise InputError(
                f"a light needs 0 <= inner cone <= outer cone <= pi/2 and a positive range, but came with "
                f"{self.inner_cone_rad}, {self.outer_cone_rad} rad and {self.range_m} m: check the light"
            )

    def transformed(self, world_from_light: Float[np.ndarray, "4 4"]) -> "Light":
        """The light moved, turned and resized together with its scene.

        A lamp in a scene twice as large needs four times the intensity for the same picture; so it gets it.
        """
        linear = world_from_light[:3, :3]
        scale = float(abs(np.linalg.det(linear)) ** (1 / 3))
        direction = linear @ np.asarray(self.direction)
        strength = 1.0 if self.kind == "directional" else scale**2
        return replace(
            self,
            rgb=(strength * self.rgb[0], strength * self.rgb[1], strength * self.rgb[2]),
            position_m=tuple((linear @ np.asarray(self.position_m) + world_from_light[:3, 3]).tolist()),
            direction=tuple((direction / np.linalg.norm(direction)).tolist()),
            range_m=self.range_m * scale,
        )

    def brighter(self, factor: float) -> "Light":
        """The same light, factor times as strong."""
        red, green, blue = self.rgb
        return replace(self, rgb=(red * factor, green * factor, blue * factor))

    def arriving_at(
        self, points_m: Float[np.ndarray, "points 3"]
    ) -> tuple[Float[np.ndarray, "points 3"], Float[np.ndarray, " points"], Float[np.ndarray, "points 3"]]:
        """(unit vectors towards the light, distance in metres, irradiance on a surface facing it), shadows not counted."""
        if self.kind == "directional":
            towards = np.broadcast_to(-np.asarray(self.direction), points_m.shape)
            return towards, np.full(len(points_m), np.inf), np.broadcast_to(np.asarray(self.rgb), points_m.shape)
        offset_m = np.asarray(self.position_m) - points_m
        distance_m = np.maximum(np.linalg.norm(offset_m, axis=-1), 1e-9)
        towards = offset_m / distance_m[:, None]
        # KHR_lights_punctual, "Range Property": inverse square, windowed.
        fraction = np.clip(1.0 - (distance_m / self.range_m) ** 4, 0.0, 1.0) / distance_m**2
        if self.kind == "spot":
            # KHR_lights_punctual, "Inner and Outer Cone Angles".
            cosine = -towards @ np.asarray(self.direction)
            width = max(1e-3, cos(self.inner_cone_rad) - cos(self.outer_cone_rad))
            fraction = fraction * np.clip((cosine - cos(self.outer_cone_rad)) / width, 0.0, 1.0) ** 2
        return towards, distance_m, fraction[:, None] * np.asarray(self.rgb)


def sun(direction: Triple, irradiance: float | Triple) -> Light:
    """A directional light: the way its rays travel (any length), and the linear irradiance on a surface facing it."""
    travel = np.asarray(direction, dtype=np.float64)
    length = float(np.linalg.norm(travel))
    if length == 0:
        raise InputError("a sun needs a direction, but got (0, 0, 0): give the vector along which its light travels")
    rgb = irradiance if isinstance(irradiance, tuple) else (irradiance, irradiance, irradiance)
    return Light("directional", rgb, direction=tuple((travel / length).tolist()))
