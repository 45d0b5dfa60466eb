"""Scenes in motion for the stochastic sampler: bodies that move in straight lines, and the stage that places them by their blur."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from datasets_scripts.traced_scene import DiscLight, Quad, Scene, Sphere, Texture, Vector
from mrbokeh.optics.lens import Lens

_STILL: Vector = (0.0, 0.0, 0.0)
_SUN_DIRECTION: Vector = (-0.36, -0.64, -0.68)


@dataclass(frozen=True, eq=False)
class Mover:
    """A body where it is in the middle of the exposure, and what it moves in metres per shutter.

    is_round: of a quad, only the ellipse that touches its edges. in_front: part of the front layer, else of the rest.
    """

    body: Quad | Sphere | DiscLight
    velocity_m: Vector = _STILL
    is_round: bool = False
    in_front: bool = False


@dataclass(frozen=True, eq=False)
class MovingScene:
    """Bodies and light; axes of the camera (x right, y down, z forward, the lens at the origin), metres."""

    movers: tuple[Mover, ...]
    sun_direction: Vector = _SUN_DIRECTION
    sun: float = 0.75
    ambient: float = 0.45
    background_rgb: Vector = (0.0, 0.0, 0.0)

    @property
    def ordered(self) -> tuple[Mover, ...]:
        """Quads first, then spheres, then lamps: the order of a packed scene."""
        return tuple(mover for kind in (Quad, Sphere, DiscLight) for mover in self.movers if isinstance(mover.body, kind))

    @property
    def has_layers(self) -> bool:
        return len({mover.in_front for mover in self.movers}) == 2

    def part(self, in_front: bool) -> "MovingScene":
        """The front layer or everything else, as if the other were not there."""
        return replace(self, movers=tuple(mover for mover in self.movers if mover.in_front == in_front))

    def at(self, time: float) -> Scene:
        """All bodies where they are at a time of the exposure, 0 to 1."""
        moved = [_moved(mover.body, (time - 0.5) * np.asarray(mover.velocity_m)) for mover in self.ordered]
        return Scene(
            tuple(body for body in moved if isinstance(body, Quad)),
            tuple(body for body in moved if isinstance(body, Sphere)),
            tuple(body for body in moved if isinstance(body, DiscLight)),
            self.sun_direction,
            self.sun,
            self.ambient,
            self.background_rgb,
        )


def _moved(body: Quad | Sphere | DiscLight, by_m: np.ndarray) -> Quad | Sphere | DiscLight:
    if isinstance(body, Quad):
        return replace(body, corner_m=vector(body.corner_m + by_m))
    return replace(body, centre_m=vector(body.centre_m + by_m))


def vector(values: Sequence[float] | np.ndarray) -> Vector:
    x, y, z = (float(value) for value in values)
    return x, y, z


@dataclass(frozen=True)
class Stage:
    """Places things by what they look like: the same composition, blur and motion at every size of the picture.

    Positions and sizes are in half widths of the frame at the depth of the thing (the frame reaches from -1 to 1 across and
    from -aspect to aspect down); coc and motion are in widths of the frame, so pixels are this times width_px.
    """

    lens: Lens
    aspect: float

    @property
    def farthest_coc(self) -> float:
        """The circle of confusion at infinity."""
        return self.lens.coc_px_per_dioptre(1) / self.lens.focus_distance_m

    def depth_m(self, coc: float) -> float:
        return 1.0 / (1.0 / self.lens.focus_distance_m - coc / self.lens.coc_px_per_dioptre(1))

    def half_width_m(self, depth_m: float) -> float:
        return 0.5 * depth_m / self.lens.focal_px(1)

    def point_m(self, x: float, y: float, coc: float) -> np.ndarray:
        depth_m = self.depth_m(coc)
        return np.array([x * self.half_width_m(depth_m), y * self.half_width_m(depth_m), depth_m])

    def velocity_m(self, motion: tuple[float, float], coc: float, inwards_m: float = 0.0) -> Vector:
        """Metres per shutter of what moves by so many widths of the frame; inwards_m: away from the camera besides."""
        width_m = 2.0 * self.half_width_m(self.depth_m(coc))
        return motion[0] * width_m, motion[1] * width_m, inwards_m

    def card(
        self,
        place: tuple[float, float, float],
        half_size: tuple[float, float],
        texture: Texture,
        turn_rad: float = 0.0,
        tilt_rad: float = 0.0,
        repeats: tuple[float, float] = (1.0, 1.0),
    ) -> Quad:
        """A card around place (x, y, coc), turned in the picture (x towards y), its lower edge tilted away from the camera."""
        centre_m = self.point_m(*place)
        unit_m = self.half_width_m(float(centre_m[2]))
        along = half_size[0] * unit_m * np.array([np.cos(turn_rad), np.sin(turn_rad), 0.0])
        flat = np.cos(tilt_rad)
        down = half_size[1] * unit_m * np.array([-np.sin(turn_rad) * flat, np.cos(turn_rad) * flat, np.sin(tilt_rad)])
        return Quad(vector(centre_m - along - down), vector(2.0 * along), vector(2.0 * down), texture, repeats)

    def backdrop(self, coc: float, texture: Texture, repeats: tuple[float, float] = (1.0, 1.0)) -> Mover:
        """A wall that fills the frame and all that its blur can reach."""
        reach = 1.15 + abs(coc)
        return Mover(self.card((0.0, 0.0, coc), (reach, self.aspect + reach - 1.0), texture, repeats=repeats))

    def ball(self, place: tuple[float, float, float], radius: float, texture: Texture, repeats: tuple[float, float] = (1.0, 1.0)) -> Sphere:
        centre_m = self.point_m(*place)
        return Sphere(vector(centre_m), radius * self.half_width_m(float(centre_m[2])), texture, repeats)

    def lamp(self, place: tuple[float, float, float], radius: float, radiance_rgb: Vector) -> DiscLight:
        """A small bright disc that faces the sensor."""
        centre_m = self.point_m(*place)
        return DiscLight(vector(centre_m), radius * self.half_width_m(float(centre_m[2])), radiance_rgb)
