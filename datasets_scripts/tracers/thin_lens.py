"""A small ray tracer whose lens, occlusion and depth are exact: the truth for photographs made with it and for lens-blur renderers.

A ray leaves pixel position p through lens point u (unit pupil, camera axes x right, y down) and meets, in the focus plane,
the point that a pinhole at the lens centre sees through p (Cook et al. 1984, Distributed Ray Tracing; thin lens). So a point
behind the focus plane is displaced by u times half the signed circle of confusion, a point in front the other way.
A pixel is the mean radiance over its footprint and the pupil: no vignetting, no bellows factor, no loss in the glass.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from jaxtyping import Float, Float32

from datasets_scripts.tracers._thin_lens_numba import PackedScene, PackedView, shade_picture, trace_depth
from datasets_scripts.tracers.traced_scene import Scene, Texture
from mrbokeh.optics.aperture import Aperture
from mrbokeh.optics.camera import Camera
from mrbokeh.optics.lens import Lens
from mrbokeh.system.errors import InputError

_NEAREST_M = 1e-3
_UNIT_BOX = np.array([[x, y, z] for x in (-1.0, 1.0) for y in (-1.0, 1.0) for z in (-1.0, 1.0)])
_UNIT_DISC_BOX = np.array([[-1.0, -1.0, 0.0], [1.0, 1.0, 0.0]])
_UNIT_QUAD = np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]])
_LENS_DIFFERS = 1e-3
_LEAST_DRAWN = 32  # so that no pixel of a thin ring is left without a ray
_PINHOLE_PUPIL = Aperture((np.array([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]]),), (1.0,))


@dataclass(frozen=True)
class _Samples:
    """Low-discrepancy points: pixel x, y and pupil x, y in [0, 1); light_points serve lights sampled on their own."""

    points: Float[np.ndarray, "samples 4"]
    light_points: Float[np.ndarray, "light_samples 4"]


def camera_for_lens(camera: Camera, lens: Lens) -> Camera:
    """Return the camera with the focal length in pixels that the focused lens really has (focus breathing, square pixels)."""
    focal_px = lens.focal_px(camera.width_px)
    return replace(camera, focal_px=(focal_px, focal_px))


def trace(
    scene: Scene, camera: Camera, lens: Lens, samples: int, seed: int = 0, footprint_px: float = 1.0
) -> Float32[np.ndarray, "height width 3"]:
    """Return scene-linear RGB (H, W, 3) through the lens.

    samples: rays per pixel that pass the aperture (on average).
    camera: its focal_px must be that of the lens as focused (see `camera_for_lens`), else blur and geometry would disagree.
    footprint_px: side of the square that a pixel averages; above 1 it stands for an optical low-pass filter.
    """
    expected_px = lens.focal_px(camera.width_px)
    if max(abs(focal / expected_px - 1.0) for focal in camera.focal_px) > _LENS_DIFFERS:
        raise InputError(
            f"the camera has a focal length of {camera.focal_px} px, but the lens focused at {lens.focus_distance_m} m "
            f"has {expected_px:.3f} px: use camera_for_lens(camera, lens)"
        )
    view = pack_view(camera, lens.aperture, 0.5e-3 * lens.aperture_diameter_mm, 1.0 / lens.focus_distance_m, footprint_px)
    return _shaded(scene, camera, view, samples, seed)


def trace_pinhole(
    scene: Scene, camera: Camera, samples: int, seed: int = 0, footprint_px: float = 1.0
) -> tuple[Float32[np.ndarray, "height width 3"], Float32[np.ndarray, "height width"]]:
    """Return (RGB averaged over each pixel's footprint, depth in metres along the axis at its centre) from the middle of the lens."""
    view = pack_view(camera, _PINHOLE_PUPIL, 0.0, 0.0, footprint_px)
    depth_m = np.empty((camera.height_px, camera.width_px), np.float32)
    trace_depth(pack_scene(scene, camera, view), view, depth_m)
    return _shaded(scene, camera, view, samples, seed), depth_m


def _shaded(scene: Scene, camera: Camera, view: PackedView, samples: int, seed: int) -> Float32[np.ndarray, "height width 3"]:
    if samples < 1:
        raise InputError(f"expected at least 1 sample per pixel, got {samples}")
    packed = pack_scene(scene, camera, view)
    drawn = _draw_samples(view, samples, seed)
    rgb = np.empty((view.height, view.width, 3), np.float32)
    shade_picture(packed, view, drawn.points, drawn.light_points, seed, rgb)
    return rgb


def _draw_samples(view: PackedView, samples: int, seed: int) -> _Samples:
    """Draw scrambled Sobol points; every pixel later shifts them by its own vector (Cranley and Patterson 1976).

    Points of the square around the pupil that miss it are dropped while tracing, so more are drawn than asked for.
    """
    from scipy.stats import qmc

    covered = pupil_areas(view).max() / (2.0 * view.pupil_extent) ** 2
    count = max(int(np.ceil(samples / covered)), _LEAST_DRAWN if covered < 1.0 else 1)
    sobol = qmc.Sobol(4, scramble=True, rng=np.random.default_rng(seed))
    points = sobol.random_base2(int(np.ceil(np.log2(count))))
    return _Samples(points[:count], points[: max(samples // 4, 16)])


def pack_view(
    camera: Camera, aperture: Aperture, pupil_radius_m: float, inverse_focus_per_m: float, footprint_px: float = 1.0
) -> PackedView:
    """Return a camera behind a pupil; inverse_focus_per_m is the focus distance in dioptres (0 = infinity)."""
    vertices, starts, weights = aperture.packed()
    (fx, fy), (cx, cy) = camera.focal_px, camera.principal_px
    return PackedView(
        width=camera.width_px,
        height=camera.height_px,
        focal_x=fx,
        focal_y=fy,
        principal_x=cx,
        principal_y=cy,
        footprint=footprint_px,
        pupil_radius=pupil_radius_m,
        inverse_focus=inverse_focus_per_m,
        pupil_extent=float(np.abs(vertices).max()),
        vertices=vertices,
        starts=starts,
        weights=weights,
        clear=np.array([_clear(vertices[a:b]) for a, b in pairwise(starts)]),
    )


def _clear(outline: Float[np.ndarray, "vertices 2"]) -> tuple[float, float, float]:
    """Return squared distances of the nearest and farthest place of an outline from the middle, a hair wider, and whether it goes round."""
    along = np.roll(outline, -1, axis=0) - outline
    share = np.clip(-(outline * along).sum(axis=1) / np.maximum((along**2).sum(axis=1), 1e-300), 0.0, 1.0)
    nearest, farthest = np.hypot(*(outline + share[:, None] * along).T).min(), np.hypot(*outline.T).max()
    angles = np.arctan2(*np.roll(outline, -1, axis=0).T) - np.arctan2(*outline.T)
    turns = np.rint(((angles + np.pi) % (2.0 * np.pi) - np.pi).sum() / (2.0 * np.pi))
    return nearest**2 * (1.0 - 1e-9), farthest**2 * (1.0 + 1e-9), float(turns % 2.0)


def pack_scene(scene: Scene, camera: Camera, view: PackedView) -> PackedScene:
    """Return the scene in camera axes, with the pixels that each body's blur can reach."""
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
    """Return the area of each outline in units of the squared pupil radius (shoelace formula)."""
    return np.array([_polygon_area(view.vertices[a:b]) for a, b in pairwise(view.starts)])


def _polygon_area(outline: Float[np.ndarray, "vertices 2"]) -> float:
    x, y = outline.T
    return 0.5 * abs(float(np.dot(x, np.roll(y, -1)) - np.dot(y, np.roll(x, -1))))


def _vectors(rows: Sequence[tuple[float, ...]], size: int = 3) -> Float[np.ndarray, "count size"]:
    return np.asarray(rows, np.float64).reshape(-1, size)


def _packed_textures(textures: Sequence[Texture]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return (texels (T, 3), start, height and width of each distinct texture, which one each body wears)."""
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
    """Return the share of the pupil per point on the light where its blur is larger than the light, else 0, as lens rays find it."""
    weighted_area = float(np.dot(view.weights, pupil_areas(view)))
    pupil_on_light = weighted_area * (view.pupil_radius * (1.0 - depth_m * view.inverse_focus)) ** 2
    share = np.pi * radius_m**2 / np.maximum(pupil_on_light, 1e-300)
    return np.where((share < 1.0) & (depth_m > 0.0), share, 0.0)


def _bounds_px(points_m: Float[np.ndarray, "bodies points 3"], view: PackedView) -> Float[np.ndarray, "bodies 4"]:
    """Return x0, y0, x1, y1 of the convex hull of each body's points, seen from anywhere in the pupil.

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
