"""Light of a scene: directional, point and spot lights (KHR_lights_punctual), and Environment, a linear HDR panorama."""

from dataclasses import dataclass, field, replace
from functools import cache
from math import cos, inf, pi
from typing import Literal

import numpy as np
from jaxtyping import Float, Float32

from mrbokeh.scene.material import Triple
from mrbokeh.system.errors import InputError

LightKind = Literal["directional", "point", "spot"]

NEUTRAL_RADIANCE = 1.0
"""Radiance from every direction where a scene brings no light of its own: a white matte surface then shows 1."""
_SUN_RADIUS_RAD, _SKY_PERCENTILE = 0.12, 99.0


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

        A light in a scene twice as large gets four times the intensity, for the same picture.
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
        """Return the light with its strength times a factor."""
        red, green, blue = self.rgb
        return replace(self, rgb=(red * factor, green * factor, blue * factor))

    def arriving_at(
        self, points_m: Float[np.ndarray, "points 3"]
    ) -> tuple[Float[np.ndarray, "points 3"], Float[np.ndarray, " points"], Float[np.ndarray, "points 3"]]:
        """Return (unit vectors towards the light, distance in metres, irradiance on a surface facing it), without shadows."""
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


@dataclass(frozen=True, eq=False)
class Environment:
    """Radiance arriving from infinitely far.

    radiance: (H, W, 3) linear Rec.709, unclipped. Columns are longitude, rows latitude (equirectangular): the centre of
        the picture lies along +z of the environment's axes, its right half along +x, its first row up (-y).
    world_from_environment: (3, 3) rotation that turns the panorama in the world.
    """

    radiance: Float32[np.ndarray, "height width 3"]
    world_from_environment: Float[np.ndarray, "3 3"] = field(default_factory=lambda: np.eye(3))

    def __post_init__(self) -> None:
        if not np.isfinite(self.radiance).all() or self.radiance.min() < 0:
            raise InputError("an environment needs finite radiance of 0 or more, but holds other values: repair the map's pixels first")

    def turned(self, turn_rad: float) -> "Environment":
        """Rotated about the vertical: what was straight ahead (+z) goes to the right (+x) for a positive angle."""
        cosine, sine = np.cos(turn_rad), np.sin(turn_rad)
        turn = np.array([[cosine, 0.0, sine], [0.0, 1.0, 0.0], [-sine, 0.0, cosine]])
        return replace(self, world_from_environment=turn @ self.world_from_environment)

    def brighter(self, factor: float) -> "Environment":
        """Return the panorama at another exposure."""
        return replace(self, radiance=(self.radiance * np.float32(factor)))


@cache
def neutral_environment(radiance: float = NEUTRAL_RADIANCE) -> Environment:
    """Return uniform grey light from all directions."""
    return Environment(np.full((8, 16, 3), radiance, np.float32))


def directions(height_px: int, width_px: int) -> Float[np.ndarray, "height width 3"]:
    """Unit vectors, in the environment's axes, of the pixel centres of a panorama."""
    longitude = (np.arange(width_px) + 0.5) / width_px * 2 * np.pi - np.pi
    polar = (np.arange(height_px) + 0.5) / height_px * np.pi
    longitude, polar = np.meshgrid(longitude, polar)
    return np.stack([np.sin(polar) * np.sin(longitude), -np.cos(polar), np.sin(polar) * np.cos(longitude)], axis=-1)


def solid_angles_sr(height_px: int, width_px: int) -> Float[np.ndarray, "height width"]:
    """Exact solid angle of each pixel of a panorama; they sum to 4 pi."""
    border = np.cos(np.linspace(0, np.pi, height_px + 1))
    return np.repeat(((border[:-1] - border[1:]) * 2 * np.pi / width_px)[:, None], width_px, axis=1)


def split_sun(environment: Environment) -> tuple[Environment, Light]:
    """Take the sun out of a panorama: (the sky without it, a directional light of the same irradiance).

    A panorama alone casts no shadow. Within 0.12 rad of the brightest spot everything above the 99th percentile of the map's
    luminance becomes the light; the rest stays in the sky, so that no energy is lost.
    """
    radiance = environment.radiance
    towards = directions(*radiance.shape[:2])
    luminance = radiance @ np.array([0.2126, 0.7152, 0.0722], np.float32)
    brightest = np.unravel_index(np.argmax(luminance), luminance.shape)
    near = towards @ towards[brightest] > np.cos(_SUN_RADIUS_RAD)
    ceiling = np.percentile(luminance, _SKY_PERCENTILE)
    keep = np.where(near, np.minimum(1.0, ceiling / np.maximum(luminance, 1e-20)), 1.0)[..., None]
    taken = radiance * (1.0 - keep) * solid_angles_sr(*luminance.shape)[..., None]
    rgb = taken.sum((0, 1))
    if rgb.sum() <= 0:
        raise InputError("expected a panorama with a sun or lamp, but it is equally bright everywhere: add a sun by hand instead")
    centre = environment.world_from_environment @ (taken.sum(-1, keepdims=True) * towards).sum((0, 1))
    travel = -centre / np.linalg.norm(centre)
    light = Light("directional", (float(rgb[0]), float(rgb[1]), float(rgb[2])), direction=tuple(travel.tolist()))
    return replace(environment, radiance=(radiance * keep).astype(np.float32)), light
