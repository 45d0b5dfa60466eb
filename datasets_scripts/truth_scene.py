"""A truth scene: bodies and lamps in world axes, and the same as flat tables in camera axes, which a tracer takes."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Float32, Int

from datasets_scripts.traced_scene import Texture, Vector
from datasets_scripts.truth_bodies import Body
from mrbokeh.optics.camera import Camera

FACET_COLUMNS = 13
_LAMP_SIDES = 48
_BLACK = np.zeros((1, 1, 3), np.float32)


@dataclass(frozen=True)
class Lamp:
    """A small opaque disc parallel to the sensor that sends out constant linear radiance. World metres."""

    centre_m: Vector
    radius_m: float
    radiance_rgb: Vector
    thin: bool = False


@dataclass(frozen=True, eq=False)
class TruthScene:
    """Bodies and lamps in world axes (x right, y down, z forward; metres) under a sun and a sky.

    kind: "thin" where a thin foreground hides parts of the rest (both are rendered as layers too), else "open".
    sun: radiance of a white surface that faces the sun. sky_light: that of one that faces up, in the shade; half of it faces down.
    sky: texture of what is infinitely far, looked up by direction; without it there is nothing (coverage 0).
    """

    kind: str
    bodies: tuple[Body, ...]
    lamps: tuple[Lamp, ...] = ()
    sun_towards: Vector = (-0.45, -0.7, -0.55)
    sun: float = 0.55
    sky_light: float = 0.4
    sky: Texture | None = None
    focus_distances_m: tuple[float, ...] = (1.0, 2.0, 6.0)


@dataclass(frozen=True, eq=False)
class PackedScene:
    """Everything in camera axes; the triangles of the thin foreground come first.

    facets (T, 13): per triangle uv of its three corners (6), light of the sun and of the sky at them (3 + 3), tint.
    facet_texture (T, 3): start in `texels`, width, height. facet_normals (T, 3): unit, towards the camera.
    sky_texture: start, width, height; of width 0 where there is none.
    """

    vertices_m: Float32[np.ndarray, "vertices 3"]
    triangles: Int[np.ndarray, "triangles 3"]
    facets: Float32[np.ndarray, "triangles 13"]
    facet_texture: Int[np.ndarray, "triangles 3"]
    facet_normals: Float32[np.ndarray, "triangles 3"]
    texels: Float32[np.ndarray, "texels 3"]
    thin_triangles: int
    sky_texture: tuple[int, int, int]
    towards_sun: Float[np.ndarray, "3"]
    lamp_centres_m: Float[np.ndarray, "lamps 3"]
    lamps: tuple[Lamp, ...]


def pack(scene: TruthScene, camera: Camera) -> PackedScene:
    """Turn a scene into camera axes and work out the light that depends on no shadow."""
    bodies = sorted([*scene.bodies, *(_lamp_body(lamp) for lamp in scene.lamps)], key=lambda body: not body.thin)
    rotation, shift = camera.camera_from_world[:3, :3], camera.camera_from_world[:3, 3]
    sun = np.asarray(scene.sun_towards) / np.linalg.norm(scene.sun_towards)
    atlas = _Atlas()
    sky = (0, 0, 0) if scene.sky is None else atlas.place(scene.sky)
    starts = np.cumsum([0, *(len(body.vertices_m) for body in bodies)])
    triangles = np.concatenate([body.triangles + start for body, start in zip(bodies, starts, strict=False)])
    vertices_m = np.concatenate([body.vertices_m for body in bodies]) @ rotation.T + shift
    return PackedScene(
        vertices_m=vertices_m.astype(np.float32),
        triangles=triangles,
        facets=np.concatenate([_facets(body, scene, sun) for body in bodies]).astype(np.float32),
        facet_texture=np.concatenate([np.tile(atlas.place(body.texture), (len(body.triangles), 1)) for body in bodies]),
        facet_normals=_facing_camera(vertices_m, triangles).astype(np.float32),
        texels=atlas.texels(),
        thin_triangles=sum(len(body.triangles) for body in bodies if body.thin),
        sky_texture=sky,
        towards_sun=rotation @ sun,
        lamp_centres_m=np.array([lamp.centre_m for lamp in scene.lamps], np.float64).reshape(-1, 3) @ rotation.T + shift,
        lamps=scene.lamps,
    )


class _Atlas:
    """All textures in one table; each is stored once."""

    def __init__(self) -> None:
        self._places: dict[int, tuple[int, int, int]] = {}
        self._textures: list[Texture] = []
        self._filled = 0

    def place(self, texture: Texture) -> tuple[int, int, int]:
        if id(texture) not in self._places:
            self._places[id(texture)] = (self._filled, texture.shape[1], texture.shape[0])
            self._textures.append(texture)
            self._filled += texture.shape[0] * texture.shape[1]
        return self._places[id(texture)]

    def texels(self) -> Float32[np.ndarray, "texels 3"]:
        return np.concatenate([texture.reshape(-1, 3) for texture in self._textures])


def _facets(body: Body, scene: TruthScene, sun: Float[np.ndarray, "3"]) -> Float[np.ndarray, "triangles 13"]:
    corners = body.triangles
    sunlight = scene.sun * np.maximum(body.normals @ sun, 0.0)
    skylight = scene.sky_light * (0.75 - 0.25 * body.normals[:, 1])
    tint = np.full((len(corners), 1), body.tint)
    return np.concatenate([body.uv[corners].reshape(-1, 6), sunlight[corners], skylight[corners], tint], axis=1)


def _lamp_body(lamp: Lamp) -> Body:
    """The lamp as an obstacle: black, since its light is traced forwards."""
    around = np.arange(_LAMP_SIDES)
    angle = 2.0 * np.pi * around / _LAMP_SIDES
    rim = np.stack([np.cos(angle), np.sin(angle), np.zeros(_LAMP_SIDES)], axis=1)
    vertices_m = np.asarray(lamp.centre_m) + lamp.radius_m * np.concatenate([np.zeros((1, 3)), rim])
    triangles = np.stack([np.zeros(_LAMP_SIDES, int), around + 1, (around + 1) % _LAMP_SIDES + 1], axis=1)
    normals = np.tile([0.0, 0.0, -1.0], (len(vertices_m), 1))
    return Body(vertices_m, normals, np.zeros((len(vertices_m), 2)), triangles, _BLACK, thin=lamp.thin)


def _facing_camera(vertices_m: Float[np.ndarray, "v 3"], triangles: Int[np.ndarray, "t 3"]) -> Float[np.ndarray, "t 3"]:
    a, b, c = (vertices_m[triangles[:, corner]] for corner in range(3))
    normal = np.cross(b - a, c - a)
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-20)
    return np.where(np.sum(normal * (a + b + c), axis=1, keepdims=True) > 0, -normal, normal)
