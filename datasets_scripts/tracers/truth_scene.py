"""Truth scenes: bodies of triangles and lamps in world axes, and the same as flat tables in camera axes, which the tracer takes.

World metres, x right, y down. Quads, boxes, balls, wires and leaves have one texture each.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Float32, Int

from datasets_scripts.tracers.traced_scene import Texture, Vector, box_faces
from mrbokeh.optics.camera import Camera

Place = Vector | Float[np.ndarray, "3"]
_ROUND_SIDES = 96
_WIRE_SIDES = 24
FACET_COLUMNS = 13
_LAMP_SIDES = 48
_BLACK = np.zeros((1, 1, 3), np.float32)


@dataclass(frozen=True, eq=False)
class Body:
    """Triangles under one texture.

    vertices_m (V, 3); normals (V, 3), unit length, as the light sees them; uv (V, 2), 1 per repeat of the texture; triangles (T, 3).
    tint: factor on the texture. thin: whether it belongs to the foreground that is also rendered as a layer of its own.
    """

    vertices_m: Float[np.ndarray, "vertices 3"]
    normals: Float[np.ndarray, "vertices 3"]
    uv: Float[np.ndarray, "vertices 2"]
    triangles: Int[np.ndarray, "triangles 3"]
    texture: Texture
    tint: float = 1.0
    thin: bool = False


def quad(corner_m: Place, edge_u_m: Place, edge_v_m: Place, texture: Texture, repeats: tuple[float, float] = (1.0, 1.0)) -> Body:
    """Return a parallelogram; it is lit on the side from which edge_u goes right and edge_v goes down."""
    corner, edge_u, edge_v = (np.asarray(each, np.float64) for each in (corner_m, edge_u_m, edge_v_m))
    unit_uv = np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]])
    normal = np.cross(edge_v, edge_u)
    normals = np.tile(normal / np.linalg.norm(normal), (4, 1))
    triangles = np.array([[0, 1, 2], [0, 2, 3]])
    return Body(
        vertices_m=corner + unit_uv @ np.stack([edge_u, edge_v]),
        normals=normals,
        uv=unit_uv * repeats,
        triangles=triangles,
        texture=texture,
    )


def box(base_m: Place, size_m: Vector, yaw_rad: float, texture: Texture, repeats: tuple[float, float] = (1.0, 1.0)) -> list[Body]:
    """Return the five faces of a box, see `box_faces`."""
    return [quad(corner, u, v, texture, repeats) for corner, u, v in box_faces(base_m, size_m, yaw_rad)]


def ball(centre_m: Place, radius_m: float, texture: Texture, repeats: tuple[float, float] = (2.0, 1.0)) -> Body:
    """Return a finely tessellated sphere whose texture runs around the vertical axis."""
    polar = np.linspace(0.0, np.pi, _ROUND_SIDES // 2 + 1)
    around = np.linspace(0.0, 2.0 * np.pi, _ROUND_SIDES + 1)
    theta, phi = np.meshgrid(polar, around, indexing="ij")
    normals = np.stack([np.sin(theta) * np.cos(phi), -np.cos(theta), np.sin(theta) * np.sin(phi)], axis=-1).reshape(-1, 3)
    uv = np.stack([phi / (2.0 * np.pi), theta / np.pi], axis=-1).reshape(-1, 2) * repeats
    return Body(
        vertices_m=np.asarray(centre_m) + radius_m * normals,
        normals=normals,
        uv=uv,
        triangles=_grid_triangles(*theta.shape),
        texture=texture,
    )


def wire(points_m: Float[np.ndarray, "points 3"], radius_m: float, texture: Texture, repeat_m: float = 0.05, thin: bool = False) -> Body:
    """Return a round wire along a line of points; the texture repeats every `repeat_m` along it."""
    tangents = np.gradient(points_m, axis=0)
    tangents /= np.linalg.norm(tangents, axis=1, keepdims=True)
    aside = np.array([0.0, 0.0, 1.0]) - tangents[:, 2:] * tangents
    aside /= np.linalg.norm(aside, axis=1, keepdims=True)
    angle = np.linspace(0.0, 2.0 * np.pi, _WIRE_SIDES + 1)[None, :, None]
    normals = np.cos(angle) * aside[:, None] + np.sin(angle) * np.cross(tangents, aside)[:, None]
    along = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(points_m, axis=0), axis=1))]) / repeat_m
    around = np.linspace(0.0, 1.0, _WIRE_SIDES + 1)
    uv = np.stack(np.broadcast_arrays(along[:, None], around[None]), axis=-1)
    vertices = points_m[:, None] + radius_m * normals
    triangles = _grid_triangles(len(points_m), _WIRE_SIDES + 1)
    return Body(
        vertices_m=vertices.reshape(-1, 3),
        normals=normals.reshape(-1, 3),
        uv=uv.reshape(-1, 2),
        triangles=triangles,
        texture=texture,
        thin=thin,
    )


def leaf(
    centre_m: Place,
    length_m: float,
    width_m: float,
    turn: Float[np.ndarray, "3 3"],
    texture: Texture,
    tint: float = 1.0,
    thin: bool = False,
) -> Body:
    """Return a flat pointed oval in the plane of the first two rows of `turn` (unit vectors), lit on the side towards the camera."""
    t = np.linspace(0.0, 1.0, 13)
    half = 0.5 * width_m * np.sin(np.pi * t) ** 0.8
    outline = np.concatenate([np.stack([(t - 0.5) * length_m, half], 1), np.stack([(t - 0.5) * length_m, -half], 1)])
    rows = np.arange(12)
    triangles = np.concatenate([np.stack([rows, rows + 1, rows + 14], 1), np.stack([rows, rows + 14, rows + 13], 1)])
    normal = turn[2] if turn[2, 2] < 0 else -turn[2]
    uv = outline / length_m + 0.5
    vertices = np.asarray(centre_m) + outline @ turn[:2]
    return Body(
        vertices_m=vertices, normals=np.tile(normal, (len(vertices), 1)), uv=uv, triangles=triangles, texture=texture, tint=tint, thin=thin
    )


def _grid_triangles(rows: int, columns: int) -> Int[np.ndarray, "triangles 3"]:
    first = (np.arange(rows - 1)[:, None] * columns + np.arange(columns - 1)).ravel()
    upper = np.stack([first, first + 1, first + columns + 1], axis=1)
    lower = np.stack([first, first + columns + 1, first + columns], axis=1)
    return np.concatenate([upper, lower])


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
    """A scene in camera axes; the triangles of the thin foreground come first.

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
    """Return the lamp as an obstacle: black, since its light is traced forwards."""
    around = np.arange(_LAMP_SIDES)
    angle = 2.0 * np.pi * around / _LAMP_SIDES
    rim = np.stack([np.cos(angle), np.sin(angle), np.zeros(_LAMP_SIDES)], axis=1)
    vertices_m = np.asarray(lamp.centre_m) + lamp.radius_m * np.concatenate([np.zeros((1, 3)), rim])
    triangles = np.stack([np.zeros(_LAMP_SIDES, int), around + 1, (around + 1) % _LAMP_SIDES + 1], axis=1)
    normals = np.tile([0.0, 0.0, -1.0], (len(vertices_m), 1))
    return Body(
        vertices_m=vertices_m, normals=normals, uv=np.zeros((len(vertices_m), 2)), triangles=triangles, texture=_BLACK, thin=lamp.thin
    )


def _facing_camera(vertices_m: Float[np.ndarray, "v 3"], triangles: Int[np.ndarray, "t 3"]) -> Float[np.ndarray, "t 3"]:
    a, b, c = (vertices_m[triangles[:, corner]] for corner in range(3))
    normal = np.cross(b - a, c - a)
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-20)
    return np.where(np.sum(normal * (a + b + c), axis=1, keepdims=True) > 0, -normal, normal)
