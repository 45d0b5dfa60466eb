"""Soft light for a traced scene: sun with a blurred shadow and ambient light dimmed in corners, baked into each quad's lightmap.

The baked lightmap is part of the scene's definition: it is the same from every viewpoint and for every lens.
"""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float, Int

from datasets_scripts.tracers._thin_lens_numba import PackedScene, open_share
from datasets_scripts.tracers.thin_lens import pack_scene, pack_view
from datasets_scripts.tracers.traced_scene import Quad, Scene
from mrbokeh.optics.aperture import Aperture
from mrbokeh.optics.camera import Camera

_SHADOW_M = 1e6  # any hit within a scene leaves next to nothing of a ray
_WORLD_AXES = Camera(1, 1, (1.0, 1.0), (0.5, 0.5))


@dataclass(frozen=True)
class BakeSettings:
    """Fineness and reach of baked light. texel_m: size of a lightmap texel. rays: per texel, for sun and for ambient light each.

    sun_radius_rad: half the angle that the sun fills (a window rather than a star).
    ambient_reach_m: what is farther away than this dims no corner.
    """

    texel_m: float = 0.008
    rays: int = 128
    sun_radius_rad: float = 0.12
    ambient_reach_m: float = 0.25


def bake_lighting(scene: Scene, seed: int = 0, settings: BakeSettings | None = None) -> Scene:
    """Return the scene with a lightmap on every quad that has none."""
    settings = settings or BakeSettings()
    packed = pack_scene(replace(scene, lights=()), _WORLD_AXES, pack_view(_WORLD_AXES, Aperture.disc(8), 0.0, 0.0))
    rng = np.random.default_rng(seed)
    sky, sun = _cosine_directions(settings.rays, rng), _disc_directions(settings.rays, rng)
    sun_rays = (sun * [settings.sun_radius_rad, settings.sun_radius_rad, 1.0]) @ _frame(np.asarray(scene.sun_direction))
    boxes_m = _body_boxes_m(scene)
    quads = []
    for quad, box_m in zip(scene.quads, boxes_m, strict=False):
        if quad.lightmap is None:
            points_m = _lightmap_points_m(quad, settings.texel_m)
            close = np.nonzero(_gap_m(boxes_m, box_m) < settings.ambient_reach_m)[0]
            gain = scene.ambient * _open(packed, close, points_m, sky @ _frame(quad.normal), settings.ambient_reach_m)
            facing = float(quad.normal @ scene.sun_direction)
            if facing > 0.0:
                gain += scene.sun * facing * _open(packed, np.arange(len(boxes_m)), points_m, sun_rays, _SHADOW_M)
            quad = replace(quad, lightmap=gain.astype(np.float32))
        quads.append(quad)
    return replace(scene, quads=tuple(quads))


def _open(
    packed: PackedScene,
    members: Int[np.ndarray, " members"],
    points_m: Float[np.ndarray, "h w 3"],
    rays: Float[np.ndarray, "rays 3"],
    reach_m: float,
) -> Float[np.ndarray, "h w"]:
    return open_share(packed, members, points_m.reshape(-1, 3), rays, reach_m).reshape(points_m.shape[:2])


def _lightmap_points_m(quad: Quad, texel_m: float) -> Float[np.ndarray, "h w 3"]:
    """Return the middle of each texel, lifted off the quad so that its own surface casts no shadow on it."""
    edge_u, edge_v = np.asarray(quad.edge_u_m), np.asarray(quad.edge_v_m)
    width, height = (int(np.clip(np.linalg.norm(edge) / texel_m, 2, 256)) for edge in (edge_u, edge_v))
    v, u = np.meshgrid((np.arange(height) + 0.5) / height, (np.arange(width) + 0.5) / width, indexing="ij")
    return np.asarray(quad.corner_m) + u[..., None] * edge_u + v[..., None] * edge_v + 1e-4 * quad.normal


def _body_boxes_m(scene: Scene) -> Float[np.ndarray, "bodies 2 3"]:
    """Return the lowest and highest corner of the box around each quad, then each sphere."""
    boxes = []
    for quad in scene.quads:
        ends = np.stack([np.zeros(3), quad.edge_u_m, quad.edge_v_m, np.add(quad.edge_u_m, quad.edge_v_m)]) + quad.corner_m
        boxes.append([ends.min(axis=0), ends.max(axis=0)])
    boxes += [[np.subtract(ball.centre_m, ball.radius_m), np.add(ball.centre_m, ball.radius_m)] for ball in scene.spheres]
    return np.asarray(boxes)


def _gap_m(boxes_m: Float[np.ndarray, "bodies 2 3"], box_m: Float[np.ndarray, "2 3"]) -> Float[np.ndarray, " bodies"]:
    """Return the distance between boxes along the axis in which they are farthest apart; at most their true distance."""
    return np.maximum(boxes_m[:, 0] - box_m[1], box_m[0] - boxes_m[:, 1]).max(axis=1)


def _frame(axis: Float[np.ndarray, "3"]) -> Float[np.ndarray, "3 3"]:
    """Return rows: two directions across `axis`, and `axis` itself."""
    across = np.cross(axis, [0.0, 0.0, 1.0] if abs(axis[2]) < 0.9 else [1.0, 0.0, 0.0])
    across /= np.linalg.norm(across)
    return np.stack([across, np.cross(axis, across), axis])


def _cosine_directions(count: int, rng: np.random.Generator) -> Float[np.ndarray, "count 3"]:
    """Return directions over the hemisphere around z, as dense as light from there counts (Malley's method)."""
    disc = _disc_directions(count, rng)
    disc[:, 2] = np.sqrt(np.maximum(1.0 - disc[:, 0] ** 2 - disc[:, 1] ** 2, 0.0))
    return disc


def _disc_directions(count: int, rng: np.random.Generator) -> Float[np.ndarray, "count 3"]:
    """Return (x, y, 1) with x, y even over the unit disc (golden-angle spiral)."""
    radius, angle = np.sqrt((np.arange(count) + 0.5) / count), np.arange(count) * np.pi * (3.0 - np.sqrt(5.0)) + rng.uniform(0, 2 * np.pi)
    return np.column_stack([radius * np.cos(angle), radius * np.sin(angle), np.ones(count)])
