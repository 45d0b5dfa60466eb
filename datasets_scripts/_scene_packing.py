"""From Scene, Camera and pupil to the arrays that the compiled tracer takes (camera axes, metres)."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from datasets_scripts._thin_lens_tracer_numba import PackedView
from datasets_scripts._traced_bodies_numba import PackedScene
from datasets_scripts.traced_scene import Scene, Texture
from mrbokeh.optics.aperture import Aperture
from mrbokeh.optics.camera import Camera

_NEAREST_M = 1e-3
_UNIT_BOX = np.array([[x, y, z] for x in (-1.0, 1.0) for y in (-1.0, 1.0) for z in (-1.0, 1.0)])
_UNIT_DISC_BOX = np.array([[-1.0, -1.0, 0.0], [1.0, 1.0, 0.0]])
_UNIT_QUAD = np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]])


def pack_view(
    camera: Camera, aperture: Aperture, pupil_radius_m: float, inverse_focus_per_m: float, footprint_px: float = 1.0
) -> PackedView:
    """A camera behind a pupil; inverse_focus_per_m is the focus distance in dioptres (0 = infinity)."""
    vertices, starts, weights = aperture.packed()
    (fx, fy), (cx, cy) = camera.focal_px, camera.principal_px
    return PackedView(
        camera.width_px, camera.height_px, fx, fy, cx, cy, footprint_px, pupil_radius_m, inverse_focus_per_m,
        float(np.abs(vertices).max()), vertices, starts, weights,
    )  # fmt: skip


def pack_scene(scene: Scene, camera: Camera, view: PackedView) -> PackedScene:
    """The scene in camera axes, with the pixels that each body's blur can reach."""
    rotation, shift = camera.camera_from_world[:3, :3], camera.camera_from_world[:3, 3]
    corners = _vectors([quad.corner_m for quad in scene.quads]) @ rotation.T + shift
    edges_u = _vectors([quad.edge_u_m for quad in scene.quads]) @ rotation.T
    edges_v = _vectors([quad.edge_v_m for quad in scene.quads]) @ rotation.T
    centres = _vectors([sphere.centre_m for sphere in scene.spheres]) @ rotation.T + shift
    radii = np.array([sphere.radius_m for sphere in scene.spheres])
    light_centres = _vectors([light.centre_m for light in scene.lights]) @ rotation.T + shift
    light_radii = np.array([light.radius_m for light in scene.lights])
    normals = np.cross(edges_u, edges_v)
    squared = np.maximum((normals**2).sum(axis=1, keepdims=True), 1e-300)
    worn = [quad.texture for quad in scene.quads] + [sphere.texture for sphere in scene.spheres]
    texels, texture_map, texture_of = _packed_textures(worn)
    lightmap_values, lightmap = _packed_lightmaps(scene)
    quad_points = corners[:, None] + _UNIT_QUAD[:, :1] * edges_u[:, None] + _UNIT_QUAD[:, 1:] * edges_v[:, None]
    sphere_points = centres[:, None] + _UNIT_BOX * radii[:, None, None]
    light_points = light_centres[:, None] + _UNIT_DISC_BOX * light_radii[:, None, None]
    return PackedScene(
        quad_corner=corners,
        quad_normal=normals,
        quad_dual_u=np.cross(edges_v, normals) / squared,
        quad_dual_v=np.cross(normals, edges_u) / squared,
        quad_repeats=_vectors([quad.repeats for quad in scene.quads], 2),
        quad_texture=texture_of[: len(scene.quads)],
        sphere_centre=centres,
        sphere_radius=radii,
        sphere_repeats=_vectors([sphere.repeats for sphere in scene.spheres], 2),
        sphere_texture=texture_of[len(scene.quads) :],
        light_centre=light_centres,
        light_radius=light_radii,
        light_rgb=_vectors([light.radiance_rgb for light in scene.lights]),
        light_gain=_light_gains(light_centres[:, 2], light_radii, view),
        bounds_px=np.concatenate([_bounds_px(points, view) for points in (quad_points, sphere_points, light_points)]),
        texels=texels,
        texture_map=texture_map,
        lightmap_values=lightmap_values,
        lightmap=lightmap,
        world_from_camera=np.ascontiguousarray(rotation.T),
        sun_direction=rotation @ np.asarray(scene.sun_direction, np.float64),
        sun=float(scene.sun),
        ambient=float(scene.ambient),
        background_rgb=np.asarray(scene.background_rgb, np.float64),
    )


def pupil_areas(view: PackedView) -> Float[np.ndarray, " outlines"]:
    """Area of each outline in units of the squared pupil radius (shoelace formula)."""
    return np.array([_polygon_area(view.vertices[a:b]) for a, b in zip(view.starts[:-1], view.starts[1:], strict=True)])


def _polygon_area(outline: Float[np.ndarray, "vertices 2"]) -> float:
    x, y = outline.T
    return 0.5 * abs(float(np.dot(x, np.roll(y, -1)) - np.dot(y, np.roll(x, -1))))


def _vectors(rows: Sequence[tuple[float, ...]], size: int = 3) -> Float[np.ndarray, "count size"]:
    return np.asarray(rows, np.float64).reshape(-1, size)


def _packed_textures(textures: Sequence[Texture]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """(texels (T, 3), start, height and width of each distinct texture, which one each body wears)."""
    distinct = {id(texture): texture for texture in textures} or {0: np.zeros((1, 1, 3), np.float32)}
    number = {key: index for index, key in enumerate(distinct)}
    texels = np.concatenate([texture.reshape(-1, 3) for texture in distinct.values()])
    texture_map = _map_of([texture.shape[:2] for texture in distinct.values()])
    return texels.astype(np.float32), texture_map, np.array([number[id(texture)] for texture in textures], np.int64)


def _packed_lightmaps(scene: Scene) -> tuple[np.ndarray, np.ndarray]:
    maps = [np.full((1, 1), scene.unshadowed_gain(quad)) if quad.lightmap is None else quad.lightmap for quad in scene.quads]
    maps = maps or [np.ones((1, 1))]
    return np.concatenate([each.ravel() for each in maps]).astype(np.float32), _map_of([each.shape for each in maps])


def _map_of(shapes: Sequence[tuple[int, ...]]) -> np.ndarray:
    sizes = np.asarray(shapes, np.int64)
    starts = np.concatenate([[0], np.cumsum(sizes.prod(axis=1))[:-1]])
    return np.column_stack([starts, sizes]).astype(np.int64)


def _light_gains(
    depth_m: Float[np.ndarray, " lights"], radius_m: Float[np.ndarray, " lights"], view: PackedView
) -> Float[np.ndarray, " lights"]:
    """Share of the pupil per point on the light where its blur is larger than the light, else 0: the lens rays find it well enough."""
    weighted_area = float(np.dot(view.weights, pupil_areas(view)))
    pupil_on_light = weighted_area * (view.pupil_radius * (1.0 - depth_m * view.inverse_focus)) ** 2
    share = np.pi * radius_m**2 / np.maximum(pupil_on_light, 1e-300)
    return np.where((share < 1.0) & (depth_m > 0.0), share, 0.0)


def _bounds_px(points_m: Float[np.ndarray, "bodies points 3"], view: PackedView) -> Float[np.ndarray, "bodies 4"]:
    """x0, y0, x1, y1 of the convex hull of each body's points, seen from anywhere in the pupil.

    The blur radius of a depth is focal_px * pupil_radius * |1/z - 1/d_f|, which is largest at one end of the depth range.
    """
    if len(points_m) == 0:
        return np.empty((0, 4))
    depth_m = np.maximum(points_m[..., 2], _NEAREST_M)
    centre = points_m[..., :2] / depth_m[..., None] * (view.focal_x, view.focal_y) + (view.principal_x, view.principal_y)
    defocus = np.abs(1.0 / depth_m - view.inverse_focus).max(axis=1)
    reach = 0.5 * view.footprint + 0.5 + max(view.focal_x, view.focal_y) * view.pupil_radius * view.pupil_extent * defocus[:, None]
    bounds = np.concatenate([centre.min(axis=1) - reach, centre.max(axis=1) + reach], axis=1)
    behind_lens = (points_m[..., 2] <= _NEAREST_M).any(axis=1)
    bounds[behind_lens] = (-np.inf, -np.inf, np.inf, np.inf)
    return bounds
