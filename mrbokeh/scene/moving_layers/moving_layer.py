"""Layers of moving objects and of their shadows.

Surfaces that are seen in the middle of the shutter's time are followed over the picture, in scenes that move as rigid bodies or bend:
skins, morphs, single parts. Straight paths give one picture with motion channels, moved row by row for a rolling shutter; bent paths give
the average of many pictures.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import cv2
import numpy as np
from embreex.mesh_construction import TriangleMesh
from embreex.rtcore_scene import EmbreeScene
from jaxtyping import Bool, Float, Float32, Float64, Int64

from mrbokeh.distortion.warping import resampled
from mrbokeh.images.layer import Layer
from mrbokeh.layering.motion import MOTION
from mrbokeh.layering.pixel_box import Box, lit_box
from mrbokeh.optics.camera import Camera
from mrbokeh.scene.mesh import Mesh, rigid_motion
from mrbokeh.scene.moving_layers.filmed_scene import FilmedScene, ShutterTiming
from mrbokeh.scene.virtual_scene import Scene, SceneRenderer, shadow_layer
from mrbokeh.system.errors import InputError

_BEFORE = 2.0**-9
"""A ray starts this part of its length before the depth that the layer states, past what is cut out or shines through before it."""
_NEAR = 2.0**-6
"""A surface is taken for the one that is shown where it lies within this part of the stated depth."""

FRACTIONS = (-0.5, -0.25, 0.0, 0.25, 0.5)
"""Moments of the time span at which paths are looked at, from its middle."""
_MOST = 99.9
"""Per cent of the pixels that decide: surfaces are found again at nearly all, but at an edge one may belong to another."""
_LOOKED_AT = 20000
"""Pixels, evenly over what is visible, at which more than the ends of paths is looked at."""
Places = Float64[np.ndarray, "points 2"]


@dataclass(frozen=True, eq=False)
class SurfacePoints:
    """Points of a scene that an eye sees, by which they can be found again when the scene has moved."""

    scene: Scene
    eye_m: Float[np.ndarray, "3"]
    points_m: Float64[np.ndarray, "points 3"]

    def at(self, scene: Scene, every: int = 1) -> Float64[np.ndarray, "some 3"] | None:
        """Return the same points of the surface, or every n-th, in another pose of the scene; None if its triangles are others.

        A rigid motion of the whole is exact; else points follow their triangles, and are NaN where they lie on none, for instance where
        a layer states the depth of another place in its pixel.
        """
        if scene is self.scene:
            return self.points_m[::every]
        before, after = self.scene.drawn_meshes, scene.drawn_meshes
        motion = rigid_motion(before, after)
        if motion is not None:
            return self.points_m[::every] @ motion[:3, :3].T + motion[:3, 3]
        return self.following_triangles(after, every)

    def following_triangles(self, after: Sequence[Mesh], every: int = 1) -> Float64[np.ndarray, "some 3"] | None:
        """`at` for what does not move as one body."""
        before = self.scene.drawn_meshes
        if len(before) != len(after) or any(not np.array_equal(a.triangles, b.triangles) for a, b in zip(before, after, strict=True)):
            return None
        triangle, weights = (values[::every] for values in self._held)
        return np.where((triangle >= 0)[:, None], np.einsum("pc,pck->pk", weights, _corners_m(after)[triangle]), np.nan)

    @cached_property
    def _held(self) -> tuple[Int64[np.ndarray, " points"], Float64[np.ndarray, "points 3"]]:
        """The triangle of each point, -1 for none, and barycentric weights of its corners."""
        corners_m = _corners_m(self.scene.drawn_meshes)
        centre_m = corners_m.reshape(-1, 3).mean(axis=0)
        rays = EmbreeScene(robust=True)
        TriangleMesh(rays, (corners_m - centre_m).astype(np.float32))
        directions = self.points_m - self.eye_m
        starts = self.eye_m - centre_m + (1.0 - _BEFORE) * directions
        hits = rays.run(starts.astype(np.float32), np.ascontiguousarray(directions, np.float32), query="INTERSECT").astype(np.int64)
        weights, length = _met(corners_m[hits], self.eye_m, directions)
        return np.where((hits >= 0) & (np.abs(length - 1.0) < _NEAR), hits, -1), weights


def _corners_m(meshes: Sequence[Mesh]) -> Float64[np.ndarray, "triangles 3 3"]:
    return np.concatenate([mesh.positions_m[mesh.triangles] for mesh in meshes])


def _met(
    corners_m: Float64[np.ndarray, "points 3 3"], eye_m: Float[np.ndarray, "3"], directions: Float[np.ndarray, "points 3"]
) -> tuple[Float64[np.ndarray, "points 3"], Float64[np.ndarray, " points"]]:
    """Barycentric weights and the place along each ray where it meets its triangle's plane (Moeller and Trumbore 1997)."""
    side_1, side_2, to_eye = corners_m[:, 1] - corners_m[:, 0], corners_m[:, 2] - corners_m[:, 0], eye_m - corners_m[:, 0]
    p, q = np.cross(directions, side_2), np.cross(to_eye, side_1)
    determinant = np.einsum("pk,pk->p", p, side_1)
    determinant = np.where(determinant == 0.0, np.nan, determinant)
    w1, w2 = np.einsum("pk,pk->p", p, to_eye) / determinant, np.einsum("pk,pk->p", q, directions) / determinant
    return np.stack([1.0 - w1 - w2, w1, w2], axis=-1), np.einsum("pk,pk->p", q, side_2) / determinant


@dataclass(frozen=True)
class Paths:
    """Motion of a picture over a time span.

    motion_px: (h, w, 2) over a box of the picture, from the beginning to the end of the span, at the places of its middle. bend_px:
    largest deviation from even motion between the ends, by curving or by uneven speed. length_px: length of the longest path, piece by
    piece.
    """

    box: Box
    motion_px: Float32[np.ndarray, "height width 2"]
    bend_px: float
    length_px: float


def paths_of(layer: Layer, filmed: FilmedScene, middle_s: float, span_s: float) -> Paths | None:
    """Paths of what a layer, rendered in the middle of a time span, shows; None where they cannot be found.

    The layer's depth is taken to lie in the middle of the pixel. Where the surface is not found again, and around what is
    visible, a pixel moves like the nearest one that was found.
    """
    box, camera = lit_box(layer), filmed.camera_at(middle_s)
    depth_m = layer.depth_m[box.where]
    visible = np.isfinite(depth_m) & (layer.alpha[box.where] > 0)
    rows, columns = np.nonzero(visible)
    centres_px = np.stack([columns + box.left + 0.5, rows + box.top + 0.5], axis=-1)
    points_m = camera.unproject(centres_px, depth_m[visible].astype(np.float64))
    points = SurfacePoints(filmed.scene_at(middle_s), camera.world_from_camera[:3, 3], points_m)
    ends = [_seen_px(points, filmed, middle_s + fraction * span_s, 1) for fraction in (FRACTIONS[0], FRACTIONS[-1])]
    every = max(1, len(centres_px) // _LOOKED_AT)
    between = [_seen_px(points, filmed, middle_s + fraction * span_s, every) for fraction in (FRACTIONS[1], FRACTIONS[3])]
    first, last, second, fourth = (*ends, *between)
    if first is None or last is None or second is None or fourth is None:
        return None
    motion_px = _dense((last - first).astype(np.float32), visible)
    course = np.stack([first[::every], second, centres_px[::every], fourth, last[::every]])
    course = course[:, np.isfinite(course).all(axis=(0, -1))]
    return None if motion_px is None or not course.size else Paths(box, motion_px, _bend_px(course), _length_px(course))


def _seen_px(points: SurfacePoints, filmed: FilmedScene, moment_s: float, every: int) -> Places | None:
    """Return the places at which points are seen at a moment; NaN behind the camera and for points that were not found again."""
    moved_m, camera = points.at(filmed.scene_at(moment_s), every), filmed.camera_at(moment_s)
    return None if moved_m is None else _projected(camera, moved_m)


def _projected(camera: Camera, points_m: Float64[np.ndarray, "points 3"]) -> Places:
    in_front = points_m @ camera.camera_from_world[2, :3] + camera.camera_from_world[2, 3] > 0.0
    return camera.project(points_m if in_front.all() else np.where(in_front[:, None], points_m, np.nan))[0]


def _dense(
    motion_px: Float32[np.ndarray, "points 2"], visible: Bool[np.ndarray, "height width"]
) -> Float32[np.ndarray, "height width 2"] | None:
    """Every pixel without motion gets that of the nearest with it; None where nothing has."""
    known = np.isfinite(motion_px).all(axis=1)
    if not known.any():
        return None
    missing = np.ones(visible.shape, np.uint8)
    missing[visible] = ~known
    _, label = cv2.distanceTransformWithLabels(missing, cv2.DIST_L2, 5, labelType=cv2.DIST_LABEL_PIXEL)
    by_label = np.zeros((int(label.max()) + 1, 2), np.float32)
    by_label[label[missing == 0]] = motion_px[known]
    return by_label[label]


def _bend_px(course: Float64[np.ndarray, "moments points 2"]) -> float:
    first, last = course[0], course[-1]
    even = (first + (fraction + 0.5) * (last - first) for fraction in FRACTIONS)
    away = [np.linalg.norm(place - expected, axis=-1) for place, expected in zip(course, even, strict=True)]
    return float(np.percentile(np.max(away, axis=0), _MOST))


def _length_px(course: Float64[np.ndarray, "moments points 2"]) -> float:
    return float(np.percentile(np.linalg.norm(np.diff(course, axis=0), axis=-1).sum(axis=0), _MOST))


Rendering = Callable[[Scene, Camera], Layer]

_STEPS = 10
_CLOSE_PX = 0.01
_LEAST_SAMPLES = 8
_SAMPLES = 16


@dataclass(frozen=True)
class MotionQuality:
    """Limits between one picture with motion channels and an average.

    most_bend_px: largest deviation of a path from even motion before pictures are averaged. A body that turns by an angle a bends the
    path of a point at a radius of r pixels by r (1 - cos(a / 2)): half a pixel is 11 degrees at 100 px, 3.6 degrees at 1000 px.
    most_samples: number of averaged pictures; fewer if paths are shorter in pixels.
    """

    most_bend_px: float = 0.5
    most_samples: int = 64


_USUAL = MotionQuality()


def moving_layer(renderer: SceneRenderer, filmed: FilmedScene, time_s: float, quality: MotionQuality = _USUAL) -> Layer:
    """The scene as its camera sees it in the frame of a time, sharp but for motion, which stands in the layer's motion channels.

    mrbokeh's renderers draw it out before they blur it by the lens. Where nothing moves the layer is the renderer's own,
    without motion channels. Where paths bend by more than quality allows, where the scene's triangles change, or where a point
    passes the camera, the layer is `accumulated`: blurred already, without motion channels. Light does not change with the
    motion, and what comes into the frame only before or after the middle of the shutter is missing.
    """
    return followed(renderer.render, filmed, time_s, quality)


def followed(rendering: Rendering, filmed: FilmedScene, time_s: float, quality: MotionQuality = _USUAL) -> Layer:
    """`moving_layer` for anything that makes a layer with depth out of scene and camera."""
    filmed = filmed.remembering()
    shutter, middle_s = filmed.shutter, filmed.shutter.middle_s(time_s)
    span_s = shutter.exposure_s + abs(shutter.readout_s)
    layer = rendering(filmed.scene_at(middle_s), filmed.camera_at(middle_s))
    if span_s == 0.0 or filmed.is_still(tuple(middle_s + fraction * span_s for fraction in FRACTIONS)):
        return layer
    if not (layer.alpha > 0).any():
        return layer
    paths = paths_of(layer, filmed, middle_s, span_s)
    if paths is None or paths.bend_px > quality.most_bend_px:
        return accumulated(rendering, filmed, time_s, samples_for(paths, quality))
    if shutter.exposure_s > 0.0:
        layer = _with_motion(layer, paths, shutter.exposure_s / span_s)
    return rolled(layer, paths, span_s, shutter) if shutter.is_rolling else layer


def samples_for(paths: Paths | None, quality: MotionQuality) -> int:
    """Return as many pictures as the longest path has pixels, within bounds; the most if paths are unknown."""
    if paths is None:
        return quality.most_samples
    return min(max(int(np.ceil(paths.length_px)), _LEAST_SAMPLES), quality.most_samples)


def _with_motion(layer: Layer, paths: Paths, share: float) -> Layer:
    """`mrbokeh.layering.motion.with_motion` for a part of the paths' time, within their box alone."""
    motion_px = np.zeros((*layer.alpha.shape, 2), np.float32)
    motion_px[paths.box.where] = paths.motion_px * np.float32(share) * layer.alpha[paths.box.where][..., None]
    return replace(layer, extra={**layer.extra, MOTION: motion_px})


@dataclass(frozen=True)
class ShadowCatcher:
    """A level catcher, and how dark its shadow is where no light arrives (0 to 1)."""

    mesh: Mesh
    strength: float = 1.0


def moving_shadow_layer(
    renderer: SceneRenderer, filmed: FilmedScene, time_s: float, catcher: ShadowCatcher, samples: int = _SAMPLES
) -> Layer:
    """The layer of a scene's shadow in the frame of a time.

    Where only the camera moves, the shadow lies still on the ground: its layer has motion channels, like any. A shadow that
    moves itself changes its shape without surfaces that could be followed: `samples` shadows are averaged.
    """

    def rendering(scene: Scene, camera: Camera) -> Layer:
        return shadow_layer(renderer, scene, camera, catcher.mesh, catcher.strength)

    shutter, middle_s = filmed.shutter, filmed.shutter.middle_s(time_s)
    span_s = shutter.exposure_s + abs(shutter.readout_s)
    if span_s > 0.0 and not filmed.is_scene_still((middle_s - 0.5 * span_s, middle_s, middle_s + 0.5 * span_s)):
        return accumulated(rendering, filmed, time_s, samples)
    # On the ground, whatever is seen keeps its place: nothing has to be followed but the camera.
    scene = filmed.scene_at(middle_s)
    return followed(rendering, replace(filmed, scene_at=lambda _: scene), time_s, MotionQuality(most_samples=samples))


def accumulated(rendering: Rendering, filmed: FilmedScene, time_s: float, samples: int, band_px: int = 8) -> Layer:
    """The mean of `samples` pictures over the shutter, premultiplied; depth is the one that is seen nearest to the middle of it.

    rendering: such as `renderer.render`. band_px: with a rolling shutter, so many rows are exposed at one time, that of their
    middle. Blurred already, the layer has no motion channels. It cannot tell light of different depths in one pixel apart.
    """
    if samples < 1 or band_px < 1:
        raise InputError(f"an accumulation needs at least one picture and bands of one row, got {samples} and {band_px}")
    height_px = filmed.camera_at(filmed.shutter.middle_s(time_s)).height_px
    step = band_px if filmed.shutter.is_rolling else height_px
    bands = [_band(rendering, filmed, time_s, samples, (top, min(top + step, height_px))) for top in range(0, height_px, step)]
    names = bands[0].extra
    return Layer(
        np.concatenate([band.rgb for band in bands]),
        np.concatenate([band.alpha for band in bands]),
        np.concatenate([band.depth_m for band in bands]),
        {name: np.concatenate([band.extra[name] for band in bands]) for name in names},
    )


def _band(rendering: Rendering, filmed: FilmedScene, time_s: float, samples: int, rows: tuple[int, int]) -> Layer:
    shutter = filmed.shutter
    height_px = filmed.camera_at(time_s).height_px
    middle_s = time_s + shutter.row_delay_s(0.5 * (rows[0] + rows[1]), height_px)
    offsets = (np.arange(samples) + 0.5) / samples - 0.5
    order = np.argsort(np.abs(offsets), kind="stable")
    total: Layer | None = None
    for offset in offsets[order].tolist():
        moment_s = middle_s + offset * shutter.exposure_s
        camera = filmed.camera_at(moment_s)
        shown = rendering(filmed.scene_at(moment_s), Box(*rows, 0, camera.width_px).camera_of(camera))
        total = shown if total is None else _sum(total, shown)
    assert total is not None
    share = np.float32(1.0 / samples)
    alpha = np.minimum(total.alpha * share, np.float32(1.0))
    return Layer(total.rgb * share, alpha, total.depth_m, {name: values * share for name, values in total.extra.items()})


def _sum(one: Layer, other: Layer) -> Layer:
    return Layer(
        one.rgb + other.rgb,
        one.alpha + other.alpha,
        np.where(np.isfinite(one.depth_m), one.depth_m, other.depth_m),
        {name: values + other.extra[name] for name, values in one.extra.items()},
    )


def rolled(layer: Layer, paths: Paths, span_s: float, shutter: ShutterTiming) -> Layer:
    """The layer of the middle row's moment, moved row by row along its paths to where each row sees it.

    paths: over `span_s`, of what the layer shows. Motion channels become what the rows see of them: what runs with the readout
    is drawn longer. Things that move differently side by side are told apart only where they are in the middle.
    """
    box = paths.box.grown(int(np.ceil(paths.length_px)) + 1).within(layer.alpha.shape)
    x, y = np.meshgrid(np.arange(box.left - 1, box.right + 1) + 0.5, np.arange(box.top - 1, box.bottom + 1) + 0.5)
    delay_s = np.array([shutter.row_delay_s(row, layer.height_px) for row in y[:, 0].tolist()]) - 0.5 * shutter.readout_s
    positions_px = _sources_px(np.stack([x, y], axis=-1), paths, delay_s / span_s)
    return box.placed(resampled(layer, positions_px, paths.box), layer.alpha.shape)


def _sources_px(
    xy_px: Float64[np.ndarray, "rows columns 2"], paths: Paths, delays: Float64[np.ndarray, " rows"]
) -> Float64[np.ndarray, "rows columns 2"]:
    """The places p with p + motion(p) delay = xy, by repeated substitution."""
    found = xy_px
    for _ in range(_STEPS):
        at = (found - (paths.box.left + 0.5, paths.box.top + 0.5)).astype(np.float32)
        motion_px = cv2.remap(paths.motion_px, at[..., 0], at[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        last, found = found, xy_px - motion_px.astype(np.float64) * delays[:, None, None]
        if np.abs(found - last).max() < _CLOSE_PX:
            break
    return found
