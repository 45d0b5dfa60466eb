"""Environment: the light that comes from everywhere, as a linear HDR panorama in longitude and latitude."""

from dataclasses import dataclass, field, replace
from functools import cache

import numpy as np
from jaxtyping import Float, Float32

from mrbokeh.scene.light import Light
from mrbokeh.system.errors import InputError

NEUTRAL_RADIANCE = 1.0
"""Radiance from every direction where a scene brings no light of its own: a white matte surface then shows 1."""


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
        """The same panorama at another exposure."""
        return replace(self, radiance=(self.radiance * np.float32(factor)))


@cache
def neutral_environment(radiance: float = NEUTRAL_RADIANCE) -> Environment:
    """The same grey light from everywhere."""
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


def split_sun(environment: Environment, width_rad: float = 0.12, ceiling_percentile: float = 99.0) -> tuple[Environment, Light]:
    """Take the sun out of a panorama: (the sky without it, a directional light of the same irradiance).

    A panorama alone casts no shadow. Within `width_rad` of the brightest spot everything above the percentile of the map's
    luminance becomes the light; the rest stays in the sky, so that no energy is lost.
    """
    radiance = environment.radiance
    towards = directions(*radiance.shape[:2])
    luminance = radiance @ np.array([0.2126, 0.7152, 0.0722], np.float32)
    brightest = np.unravel_index(np.argmax(luminance), luminance.shape)
    near = towards @ towards[brightest] > np.cos(width_rad)
    ceiling = np.percentile(luminance, ceiling_percentile)
    keep = np.where(near, np.minimum(1.0, ceiling / np.maximum(luminance, 1e-20)), 1.0)[..., None]
    taken = radiance * (1.0 - keep) * solid_angles_sr(*luminance.shape)[..., None]
    rgb = taken.sum((0, 1))
    if rgb.sum() <= 0:
        raise InputError("expected a panorama with a sun or lamp, but it is equally bright everywhere: add a sun by hand instead")
    centre = environment.world_from_environment @ (taken.sum(-1, keepdims=True) * towards).sum((0, 1))
    travel = -centre / np.linalg.norm(centre)
    light = Light("directional", (float(rgb[0]), float(rgb[1]), float(rgb[2])), direction=tuple(travel.tolist()))
    return replace(environment, radiance=(radiance * keep).astype(np.float32)), light
