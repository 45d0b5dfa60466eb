"""Bodies of the truth scenes as triangles: quads, boxes, balls, wires and leaves, each with one texture. World metres, x right, y down."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from datasets_scripts.traced_scene import Texture, Vector

Place = Vector | Float[np.ndarray, "3"]

_ROUND_SIDES = 96
_WIRE_SIDES = 24


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
    """A parallelogram; it is lit on the side from which edge_u goes right and edge_v goes down."""
    corner, edge_u, edge_v = (np.asarray(each, np.float64) for each in (corner_m, edge_u_m, edge_v_m))
    unit_uv = np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]])
    normal = np.cross(edge_v, edge_u)
    normals = np.tile(normal / np.linalg.norm(normal), (4, 1))
    triangles = np.array([[0, 1, 2], [0, 2, 3]])
    return Body(corner + unit_uv @ np.stack([edge_u, edge_v]), normals, unit_uv * repeats, triangles, texture)


def box(base_m: Place, size_m: Vector, yaw_rad: float, texture: Texture, repeats: tuple[float, float] = (1.0, 1.0)) -> list[Body]:
    """A box (width, height, depth) that stands with the middle of its base on base_m, turned about the vertical axis; no bottom."""
    width, height, depth = size_m
    right = width * np.array([np.cos(yaw_rad), 0.0, np.sin(yaw_rad)])
    away = depth * np.array([-np.sin(yaw_rad), 0.0, np.cos(yaw_rad)])
    down = np.array([0.0, height, 0.0])
    front_left = np.asarray(base_m) - down - 0.5 * right - 0.5 * away
    faces = (
        (front_left, right, down),
        (front_left + right + away, -right, down),
        (front_left + right, away, down),
        (front_left + away, -away, down),
        (front_left + away, right, -away),
    )
    return [quad(corner, u, v, texture, repeats) for corner, u, v in faces]


def ball(centre_m: Place, radius_m: float, texture: Texture, repeats: tuple[float, float] = (2.0, 1.0)) -> Body:
    """A finely tessellated sphere whose texture runs around the vertical axis."""
    polar = np.linspace(0.0, np.pi, _ROUND_SIDES // 2 + 1)
    around = np.linspace(0.0, 2.0 * np.pi, _ROUND_SIDES + 1)
    theta, phi = np.meshgrid(polar, around, indexing="ij")
    normals = np.stack([np.sin(theta) * np.cos(phi), -np.cos(theta), np.sin(theta) * np.sin(phi)], axis=-1).reshape(-1, 3)
    uv = np.stack([phi / (2.0 * np.pi), theta / np.pi], axis=-1).reshape(-1, 2) * repeats
    return Body(np.asarray(centre_m) + radius_m * normals, normals, uv, _grid_triangles(*theta.shape), texture)


def wire(points_m: Float[np.ndarray, "points 3"], radius_m: float, texture: Texture, repeat_m: float = 0.05, thin: bool = False) -> Body:
    """A round wire along a line of points; the texture repeats every `repeat_m` along it."""
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
    return Body(vertices.reshape(-1, 3), normals.reshape(-1, 3), uv.reshape(-1, 2), triangles, texture, thin=thin)


def leaf(
    centre_m: Place,
    length_m: float,
    width_m: float,
    turn: Float[np.ndarray, "3 3"],
    texture: Texture,
    tint: float = 1.0,
    thin: bool = False,
) -> Body:
    """A flat pointed oval in the plane of the first two rows of `turn` (unit vectors); it is lit on the side towards the camera."""
    t = np.linspace(0.0, 1.0, 13)
    half = 0.5 * width_m * np.sin(np.pi * t) ** 0.8
    outline = np.concatenate([np.stack([(t - 0.5) * length_m, half], 1), np.stack([(t - 0.5) * length_m, -half], 1)])
    rows = np.arange(12)
    triangles = np.concatenate([np.stack([rows, rows + 1, rows + 14], 1), np.stack([rows, rows + 14, rows + 13], 1)])
    normal = turn[2] if turn[2, 2] < 0 else -turn[2]
    uv = outline / length_m + 0.5
    vertices = np.asarray(centre_m) + outline @ turn[:2]
    return Body(vertices, np.tile(normal, (len(vertices), 1)), uv, triangles, texture, tint, thin)


def _grid_triangles(rows: int, columns: int) -> Int[np.ndarray, "triangles 3"]:
    first = (np.arange(rows - 1)[:, None] * columns + np.arange(columns - 1)).ravel()
    upper = np.stack([first, first + 1, first + columns + 1], axis=1)
    lower = np.stack([first, first + columns + 1, first + columns], axis=1)
    return np.concatenate([upper, lower])
