"""Late reprojection: a blurred layer, drawn for one pose, moved to a newer one by its depth (Mark et al. 1997, Post-rendering 3D warping).

Not the sharp picture is moved and blurred again, which would cost a drawing, but the blurred one: each of its pixels by the depth of
what it shows (mrbokeh's circles of confusion change little while the camera moves by a few pixels). The map is the inverse one, from new
pixels to old: a fixed point, for the depth is known in the old picture. It is solved on every 4th pixel and bilinear between.

LayerDepth gives that depth: of all that a blurred pixel shows, the mean, filled outwards where it shows nothing.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
from jaxtyping import Float, Float32

from mrbokeh.compositing.overlay import Overlay
from mrbokeh.images.layer import Layer
from mrbokeh.layering.layering import Layering
from mrbokeh.optics.aperture import Aperture
from mrbokeh.optics.camera import Camera
from mrbokeh.optics.lens import Lens
from mrbokeh.renderers.base import Renderer
from mrbokeh.renderers.choose import make_renderer
from viewfinder.stage._reprojection_numba import DepthGrid, Motion, sample, source_nodes

GRID_PX = 4
"""Pixels of the layer per pixel of the grid of depths."""
_OCTAGON = Aperture.blades(8)
_LEAST = 1e-5

Plane = Float32[np.ndarray, "height width"]


class LayerDepth:
    """Depth by which a blurred layer moves: 1 / depth spread as the lens spreads light, at a quarter of the resolution.

    A pixel of a bokeh disc moves as the point does that it comes from, and that may lie half a disc away: so the depth has to be
    spread with the weights of the light. 1 / depth and not depth is averaged, because parallax is linear in it. An octagon stands for any
    opening.
    """

    def __init__(self) -> None:
        self._renderer: Renderer = make_renderer("polygon", threads=1, layering=Layering(slices=8, sees_rims=False))

    def seen_dioptres(self, layers: Sequence[Layer], lens: Lens) -> Float32[np.ndarray, "rows columns"]:
        """Return 1 / depth on a grid of every 4th pixel of sharp layers, front first, whose sizes are multiples of 4. lens: theirs."""
        plain = replace(lens, aperture=_OCTAGON, tilt_rad=(0.0, 0.0), petzval_radius_mm=float("inf"))
        small = _as_light(layers)
        spread = self._renderer.render([small], plain)
        known = 1.0 / small.depth_m[small.alpha > 0]
        # Where next to nothing is seen, rounding decides about the quotient: but it is never beyond what there is.
        return np.clip(filled_outwards(spread.rgb[..., 0], spread.alpha), known.min(initial=np.inf), known.max(initial=0.0))


def _as_light(layers: Sequence[Layer]) -> Layer:
    """Return all layers as a small one whose light is 1 / depth."""
    size = (layers[0].width_px // GRID_PX, layers[0].height_px // GRID_PX)
    covered, dioptres = np.zeros_like(layers[0].alpha), np.zeros_like(layers[0].alpha)
    for layer in layers:
        share = (1.0 - covered) * layer.alpha
        dioptres += share / layer.depth_m
        covered += share
    alpha, light = _shrunk(covered, size), _shrunk(dioptres, size)
    depth_m = np.full_like(alpha, np.inf)
    np.divide(alpha, light, out=depth_m, where=light > 0)
    return Layer(np.repeat(light[..., None], 3, axis=2), alpha, depth_m)


def filled_outwards(weighted: Plane, weight: Plane) -> Plane:
    """weighted / weight; where the weight is next to nothing, what lies within two pixels, and beyond those what a pyramid pulls from
    all around (pull and push, Gortler et al., The Lumigraph, 1996)."""
    is_known = weight > _LEAST
    levels = [_grown(_grown((np.where(is_known, weighted, np.float32(0)), np.where(is_known, weight, np.float32(0)))))]
    while max(levels[-1][0].shape) > 1:
        height, width = levels[-1][0].shape
        half = (max((width + 1) // 2, 1), max((height + 1) // 2, 1))
        levels.append((_shrunk(levels[-1][0], half), _shrunk(levels[-1][1], half)))
    filled = _mean(*levels[-1], np.zeros((1, 1), np.float32))
    for values, known in reversed(levels[:-1]):
        filled = _mean(values, known, cv2.resize(filled, values.shape[::-1], interpolation=cv2.INTER_LINEAR))
    return filled


def _grown(level: tuple[Plane, Plane]) -> tuple[Plane, Plane]:
    """Give unknown pixels beside known ones the sum of these; the known ones stay."""
    values, known = level
    around = [cv2.boxFilter(plane, -1, (3, 3), normalize=False, borderType=cv2.BORDER_CONSTANT) for plane in level]
    # A sliding sum leaves crumbs of what it has passed: they are not known.
    reached = (known == 0.0) & (around[1] > _LEAST)
    return np.where(reached, around[0], values), np.where(reached, around[1], known)


def _shrunk(plane: Plane, size: tuple[int, int]) -> Float32[np.ndarray, "rows columns"]:
    return np.asarray(cv2.resize(plane, size, interpolation=cv2.INTER_AREA), np.float32)


def _mean(values: Plane, known: Plane, otherwise: Plane) -> Plane:
    result = otherwise.reshape(values.shape).copy()
    np.divide(values, known, out=result, where=known > 0)
    return result


NODE_PX = 4
_ROUNDS = 4
_PAD_PX = 1


@dataclass(frozen=True, eq=False)
class MovableLayer:
    """Picture with the depth by which it moves.

    rgba: (H, W, 4) premultiplied. dioptres: 1 / depth on a grid of every 4th pixel. camera: cut to this picture, with its pose.
    left_px, top_px: of the picture in the frame for which it was drawn, at full resolution.
    """

    rgba: Float32[np.ndarray, "height width 4"]
    dioptres: Float32[np.ndarray, "rows columns"]
    camera: Camera
    left_px: int
    top_px: int
    resolution: float = 1.0

    def moved_to(self, camera: Camera, opacity: float = 1.0) -> Overlay:
        """Return what a camera of any pose, size and focal length sees of it; in the pose of the drawing it is the drawing itself."""
        if self._is_drawn_for(camera):
            return _cut_to_frame(self.rgba, self.left_px, self.top_px, camera, opacity)
        from_drawn = camera.camera_from_world @ self.camera.world_from_camera
        left, top, right, bottom = self._lands_in(camera, from_drawn)
        if left >= right or top >= bottom:
            return _nothing()
        view = np.array([*self.camera.focal_px, *self.camera.principal_px, *camera.focal_px, *camera.principal_px])
        nodes = np.empty((-(-(bottom - top) // NODE_PX) + 1, -(-(right - left) // NODE_PX) + 1, 2))
        middle = float(np.median(self.dioptres))
        turn, shift = np.ascontiguousarray(from_drawn[:3, :3]), np.ascontiguousarray(from_drawn[:3, 3])
        depth = DepthGrid(self.dioptres, GRID_PX, middle)
        source_nodes(nodes, left, top, NODE_PX, depth, _ROUNDS, Motion(view, turn, shift))
        rgb, shines_through = np.empty((bottom - top, right - left, 3), np.float32), np.empty((bottom - top, right - left), np.float32)
        sample(rgb, shines_through, self.rgba, nodes, NODE_PX, np.float32(opacity))
        return Overlay(top, left, rgb, shines_through)

    def _is_drawn_for(self, camera: Camera) -> bool:
        principal = (camera.principal_px[0] - self.left_px, camera.principal_px[1] - self.top_px)
        same_view = self.resolution == 1.0 and camera.focal_px == self.camera.focal_px and principal == self.camera.principal_px
        return same_view and np.array_equal(camera.camera_from_world, self.camera.camera_from_world)

    def _lands_in(self, camera: Camera, from_drawn: Float[np.ndarray, "4 4"]) -> tuple[int, int, int, int]:
        """Return left, top, right, bottom of where the picture lands in the frame: of its grid of depths, corners and all."""
        rows, columns = self.dioptres.shape
        x = np.minimum(np.linspace(0.0, self.rgba.shape[1], columns + 1), self.rgba.shape[1])
        y = np.minimum(np.linspace(0.0, self.rgba.shape[0], rows + 1), self.rgba.shape[0])
        nearby = np.pad(self.dioptres, ((0, 1), (0, 1)), mode="edge")
        rays = np.stack(np.broadcast_arrays(
            (x[None, :] - self.camera.principal_px[0]) / self.camera.focal_px[0],
            (y[:, None] - self.camera.principal_px[1]) / self.camera.focal_px[1],
            1.0,
        ), axis=-1)  # fmt: skip
        points = rays @ from_drawn[:3, :3].T + nearby[..., None] * from_drawn[:3, 3]
        if not (points[..., 2] > 1e-3).all():
            return 0, 0, camera.width_px, camera.height_px
        xy_px = points[..., :2] / points[..., 2:] * camera.focal_px + camera.principal_px
        low, high = np.floor(xy_px.min((0, 1))) - _PAD_PX, np.ceil(xy_px.max((0, 1))) + _PAD_PX
        size = np.array([camera.width_px, camera.height_px])
        (left, top), (right, bottom) = (np.clip(corner, 0, size).astype(int).tolist() for corner in (low, high))
        return left, top, right, bottom


def _cut_to_frame(rgba: Float32[np.ndarray, "height width 4"], left_px: int, top_px: int, camera: Camera, opacity: float) -> Overlay:
    top, left = max(top_px, 0), max(left_px, 0)
    inside = rgba[top - top_px : max(camera.height_px - top_px, 0), left - left_px : max(camera.width_px - left_px, 0)]
    if not inside.size:
        return _nothing()
    faded = inside if opacity == 1.0 else inside * np.float32(opacity)
    return Overlay(top, left, np.ascontiguousarray(faded[..., :3]), np.float32(1.0) - faded[..., 3])


def _nothing() -> Overlay:
    return Overlay(0, 0, np.zeros((0, 0, 3), np.float32), np.zeros((0, 0), np.float32))
