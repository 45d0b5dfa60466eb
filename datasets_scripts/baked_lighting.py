"""Soft light for a traced scene: sun with a blurred shadow and ambient light dimmed in corners, baked into each quad's lightmap.

The baked lightmap is part of the scene's definition: it is the same from every viewpoint and for every lens.
"""

from dataclasses import replace

import numpy as np
from jaxtyping import Float, Float32

from datasets_scripts._baked_lighting_numba import open_sky_and_sun
from datasets_scripts._scene_packing import pack_scene, pack_view
from datasets_scripts._traced_bodies_numba import PackedScene
from datasets_scripts.traced_scene import Quad, Scene
from mrbokeh.aperture import Aperture
from mrbokeh.camera import Camera

_WORLD_AXES = Camera(1, 1, (1.0, 1.0), (0.5, 0.5))


def bake_lighting(
    scene: Scene, texel_m: float = 0.008, rays: int = 128, sun_radius_rad: float = 0.12, ambient_reach_m: float = 0.25, seed: int = 0
) -> Scene:
    """The scene with a lightmap on every quad that has none.

    texel_m: size of a lightmap texel. sun_radius_rad: half the angle that the sun fills (a window rather than a star).
    ambient_reach_m: what is farther away than this dims no corner.
    """
    view = pack_view(_WORLD_AXES, Aperture.disc(8), 0.0, 0.0)
    packed = pack_scene(replace(scene, lights=()), _WORLD_AXES, view)
    rng = np.random.default_rng(seed)
    directions = np.stack([_cosine_directions(rays, rng), _disc_directions(rays, rng)])
    quads = []
    for quad in scene.quads:
        if quad.lightmap is None:
            quad = replace(quad, lightmap=_lightmap(scene, quad, packed, directions, texel_m, sun_radius_rad, ambient_reach_m))
        quads.append(quad)
    return replace(scene, quads=tuple(quads))


def _lightmap(
    scene: Scene,
    quad: Quad,
    packed: PackedScene,
    directions: Float[np.ndarray, "2 rays 3"],
    texel_m: float,
    sun_radius_rad: float,
    reach_m: float,
) -> Float32[np.ndarray, "lightmap_height lightmap_width"]:
    edge_u, edge_v, normal = np.asarray(quad.edge_u_m), np.asarray(quad.edge_v_m), quad.normal
    width, height = (int(np.clip(np.linalg.norm(edge) / texel_m, 2, 256)) for edge in (edge_u, edge_v))
    v, u = np.meshgrid((np.arange(height) + 0.5) / height, (np.arange(width) + 0.5) / width, indexing="ij")
    points = np.asarray(quad.corner_m) + u[..., None] * edge_u + v[..., None] * edge_v + 1e-4 * normal
    sky = directions[0] @ _frame(normal)
    sun_spread = directions[1] * [sun_radius_rad, sun_radius_rad, 1.0]
    sun = sun_spread @ _frame(np.asarray(scene.sun_direction))
    sky_open, sun_open = open_sky_and_sun(packed, points.reshape(-1, 3), sky, sun, reach_m)
    facing = max(float(normal @ scene.sun_direction), 0.0)
    gain = scene.ambient * sky_open + scene.sun * facing * sun_open
    return gain.reshape(height, width).astype(np.float32)


def _frame(axis: Float[np.ndarray, "3"]) -> Float[np.ndarray, "3 3"]:
    """Rows: two directions across `axis`, and `axis` itself."""
    across = np.cross(axis, [0.0, 0.0, 1.0] if abs(axis[2]) < 0.9 else [1.0, 0.0, 0.0])
    across /= np.linalg.norm(across)
    return np.stack([across, np.cross(axis, across), axis])


def _cosine_directions(count: int, rng: np.random.Generator) -> Float[np.ndarray, "count 3"]:
    """Directions over the hemisphere around z, as many as light from there counts (Malley's method)."""
    disc = _disc_directions(count, rng)
    disc[:, 2] = np.sqrt(np.maximum(1.0 - disc[:, 0] ** 2 - disc[:, 1] ** 2, 0.0))
    return disc


def _disc_directions(count: int, rng: np.random.Generator) -> Float[np.ndarray, "count 3"]:
    """(x, y, 1) with x, y even over the unit disc (golden-angle spiral)."""
    radius, angle = np.sqrt((np.arange(count) + 0.5) / count), np.arange(count) * np.pi * (3.0 - np.sqrt(5.0)) + rng.uniform(0, 2 * np.pi)
    return np.column_stack([radius * np.cos(angle), radius * np.sin(angle), np.ones(count)])
