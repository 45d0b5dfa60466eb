"""Bodies that our ray tracer sees: textured quads and spheres and small bright discs with simple light."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Float32

from mrbokeh.system.errors import InputError

Texture = Float32[np.ndarray, "_ _ 3"]
Vector = tuple[float, float, float]


@dataclass(frozen=True, eq=False)
class Quad:
    """A parallelogram, opaque from both sides. World metres.

    corner_m: the corner where the texture starts; edge_u_m runs along texture rows, edge_v_m along columns.
    The lit side is the one from which edge_u goes right and edge_v goes down: its normal is edge_v x edge_u.
    texture: linear reflectance (or radiance where lightmap is all 1), repeated `repeats` times along the edges.
    lightmap: (h, w) factor on the texture, bilinear between its texel centres; None asks for sun and ambient light alone.
    """

    corner_m: Vector
    edge_u_m: Vector
    edge_v_m: Vector
    texture: Texture
    repeats: tuple[float, float] = (1.0, 1.0)
    lightmap: Float32[np.ndarray, "_ _"] | None = None

    @property
    def normal(self) -> Float[np.ndarray, "3"]:
        """Unit normal of the lit side."""
        normal = np.cross(self.edge_v_m, self.edge_u_m)
        length = np.linalg.norm(normal)
        if length == 0.0:
            raise InputError(f"a quad needs two edges that span an area, got {self.edge_u_m} and {self.edge_v_m}")
        return normal / length


@dataclass(frozen=True, eq=False)
class Sphere:
    """An opaque ball. World metres. Its texture's longitude and latitude lines run about the world's x axis."""

    centre_m: Vector
    radius_m: float
    texture: Texture
    repeats: tuple[float, float] = (1.0, 1.0)


@dataclass(frozen=True)
class DiscLight:
    """A small opaque disc of constant linear radiance that always lies parallel to the sensor. World metres."""

    centre_m: Vector
    radius_m: float
    radiance_rgb: Vector


@dataclass(frozen=True, eq=False)
class Scene:
    """Bodies and light. World axes x right, y down, z forward; metres.

    sun_direction: unit vector towards the sun. sun, ambient: radiance of a white surface facing the sun, or in the open shade.
    background_rgb: radiance where nothing is hit (depth inf).
    """

    quads: tuple[Quad, ...] = ()
    spheres: tuple[Sphere, ...] = ()
    lights: tuple[DiscLight, ...] = ()
    sun_direction: Vector = (0.0, -1.0, 0.0)
    sun: float = 0.0
    ambient: float = 1.0
    background_rgb: Vector = (0.0, 0.0, 0.0)

    def unshadowed_gain(self, quad: Quad) -> float:
        """Return sun (Lambert) and ambient light on the lit side of a quad with nothing in the way."""
        return self.ambient + self.sun * max(float(np.dot(quad.normal, self.sun_direction)), 0.0)


def emissive_quad(
    corner_m: Vector, edge_u_m: Vector, edge_v_m: Vector, texture: Texture, repeats: tuple[float, float] = (1.0, 1.0)
) -> Quad:
    """Return a quad whose texture is the radiance that it sends out, whatever the scene's light is."""
    return Quad(
        corner_m=corner_m, edge_u_m=edge_u_m, edge_v_m=edge_v_m, texture=texture, repeats=repeats, lightmap=np.ones((1, 1), np.float32)
    )


def box_faces(
    base_m: Sequence[float] | Float[np.ndarray, "3"], size_m: Vector, yaw_rad: float
) -> list[tuple[Float[np.ndarray, "3"], Float[np.ndarray, "3"], Float[np.ndarray, "3"]]]:
    """Return (corner, edge u, edge v) of the front, back, sides and top of a box (width, height, depth) that stands with the middle of its
    base on base_m, turned about the vertical axis; it has no bottom.
    """
    width, height, depth = size_m
    right = width * np.array([np.cos(yaw_rad), 0.0, np.sin(yaw_rad)])
    away = depth * np.array([-np.sin(yaw_rad), 0.0, np.cos(yaw_rad)])
    down = np.array([0.0, height, 0.0])
    front_left = np.asarray(base_m) - down - 0.5 * right - 0.5 * away
    back_right = front_left + right + away
    return [
        (front_left, right, down),
        (back_right, -right, down),
        (front_left + right, away, down),
        (front_left + away, -away, down),
        (front_left + away, right, -away),
    ]


def plain_texture(rgb: Vector) -> Texture:
    return np.full((1, 1, 3), rgb, np.float32)


def vector(values: Sequence[float] | np.ndarray) -> Vector:
    x, y, z = (float(value) for value in values)
    return x, y, z
