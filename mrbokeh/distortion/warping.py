"""A sharp layer of an overscanned pinhole warped into the plate's distorted pixels.

Every new pixel is the mean over the area of the old picture that it covers. The area is an upright box, as wide and high as the new
pixel's parallelogram is on average (of the same variance), and never smaller than an old pixel. All weights are positive and sum to 1:
colour does not ring, alpha stays within [0, 1], and colour, alpha and extra channels keep their proportions. Side by side, boxes of one
size leave no gaps, so that light is kept.
"""

from functools import lru_cache

import numpy as np
from jaxtyping import Float, Float32, Float64

from mrbokeh.distortion.distortion import LensDistortion
from mrbokeh.images.layer import Layer
from mrbokeh.layering.motion import motion_channels
from mrbokeh.layering.pixel_box import NOWHERE, Box, lit_box
from mrbokeh.optics.camera import Camera
from mrbokeh.system.errors import InputError

NO_MOTION = -1


def resampled(layer: Layer, positions_px: Float64[np.ndarray, "rows_and_2 columns_and_2 2"], box: Box) -> Layer:
    """Return the layer (h, w) seen at positions_px (h + 2, w + 2, 2), which have one more on every side; NaN sees nothing.

    box: outside it the layer is clear (`mrbokeh.layering.pixel_box.lit_box`). Depth is that of the nearest covering pixel, never a mixture.
    Motion becomes that of the new picture, by the derivatives of the positions.
    """
    from mrbokeh.distortion._resampling_numba import resample

    height, width = positions_px.shape[0] - 2, positions_px.shape[1] - 2
    parts = [part[box.where] for part in (layer.rgb, layer.alpha[..., None], *layer.extra.values())]
    source = np.concatenate(parts, axis=2)
    motion = motion_channels(layer.extra)
    values, depth_m = np.zeros((height, width, source.shape[2]), np.float32), np.full((height, width), np.inf, np.float32)
    if not box.is_empty:
        shifted_px = positions_px - (box.left, box.top)
        first = NO_MOTION if motion is None else motion.start
        resample(source, np.ascontiguousarray(layer.depth_m[box.where]), shifted_px, first, np.zeros(source.shape[2]), values, depth_m)
    return _layer(values, depth_m, layer)


def _layer(values: Float32[np.ndarray, "height width channels"], depth_m: Float32[np.ndarray, "height width"], like: Layer) -> Layer:
    # Sums of weights round to a little over 1.
    alpha = np.minimum(values[..., 3], np.float32(1.0))
    extra, start = {}, 4
    for name, channels in like.extra.items():
        extra[name] = values[..., start : start + channels.shape[2]].copy()
        start += channels.shape[2]
    return Layer(values[..., :3].copy(), alpha, np.where(alpha > 0, depth_m, np.float32(np.inf)), extra)


GRID_STEP_PX = 16
_FRAME_ROOM_PX = 1
"""Margin with which filters at the frame's edge find samples on both sides."""
_FINE_STEP_PX = 2
_ENOUGH = 0.999
_MOST_ENLARGED = 2.0

Pair = tuple[float, float]


def overscan_camera(camera: Camera, distortion: LensDistortion) -> Camera:
    """Return a pinhole in the plate camera's place whose frame contains all that the plate shows, grown (or cut) by whole pixels.

    The focal length stays, so that pixels are the plate's own, unless somewhere a pixel of the pinhole would cover more than
    one of the plate's; then it is raised, at most to twice, until none does. Without distortion it is the camera itself.
    """
    if distortion.is_none:
        return camera
    frame = _frame(distortion, camera.width_px, camera.height_px, camera.focal_px, camera.principal_px)
    return Camera(*frame, camera.camera_from_world)


@lru_cache(maxsize=64)
def _frame(distortion: LensDistortion, width_px: int, height_px: int, focal_px: Pair, principal_px: Pair) -> tuple[int, int, Pair, Pair]:
    """Return (width, height, focal length, principal point) of the overscan; poses, which change with every frame, do not matter."""
    camera = Camera(width_px, height_px, focal_px, principal_px)
    xy_px = distortion.undistorted_px(_grid_px(camera, GRID_STEP_PX), camera)
    if not np.isfinite(xy_px).all():
        # What is seen ends within the frame: the extremes lie next to that end.
        xy_px = distortion.undistorted_px(_grid_px(camera, _FINE_STEP_PX), camera)
    seen = np.isfinite(xy_px).all(axis=-1)
    if not seen.any():
        raise InputError("the lens distortion lets the camera see nothing at all: check its values and the focal length in pixels")
    principal, enlarged = np.asarray(principal_px), _needed_enlargement(distortion, camera)
    moved_px = principal + (xy_px[seen] - principal) * enlarged
    left, top = (np.floor(moved_px.min(axis=0)) - _FRAME_ROOM_PX).astype(int).tolist()
    right, bottom = (np.ceil(moved_px.max(axis=0)) + _FRAME_ROOM_PX).astype(int).tolist()
    fx, fy = (np.asarray(focal_px) * enlarged).tolist()
    cx, cy = (principal - (left, top)).tolist()
    return right - left, bottom - top, (fx, fy), (cx, cy)


def source_positions_px(
    distortion: LensDistortion, plate: Camera, overscan: Camera, xy_px: Float[np.ndarray, "*b 2"]
) -> Float[np.ndarray, "*b 2"]:
    """Return where the plate's positions are seen in the overscanned picture; NaN if the lens sees nothing there."""
    enlarged = np.asarray(overscan.focal_px) / np.asarray(plate.focal_px)
    undistorted = distortion.undistorted_px(xy_px, plate)
    return (undistorted - np.asarray(plate.principal_px)) * enlarged + np.asarray(overscan.principal_px)


def _grid_px(camera: Camera, step_px: int) -> Float[np.ndarray, "rows columns 2"]:
    x, y = (np.linspace(0.0, size, -(-size // step_px) + 1) for size in (camera.width_px, camera.height_px))
    return np.stack(np.meshgrid(x, y), axis=-1)


def _needed_enlargement(distortion: LensDistortion, camera: Camera) -> float:
    """Return 1 over the least length, in undistorted pixels, of a pixel of the plate in any direction."""
    around = [np.array(way) for way in ((0.5, 0.0), (-0.5, 0.0), (0.0, 0.5), (0.0, -0.5))]
    right, left, down, up = (distortion.undistorted_px(_grid_px(camera, GRID_STEP_PX) + way, camera) for way in around)
    derivative = np.stack([right - left, down - up], axis=-1)
    derivative = derivative[np.isfinite(derivative).all(axis=(-1, -2))]
    if not len(derivative):
        return 1.0
    least = float(np.linalg.svd(derivative, compute_uv=False)[:, 1].min())
    return 1.0 if least >= _ENOUGH else min(1.0 / least, _MOST_ENLARGED)


_ROOM_PX = 3
_BORDER_STEP_PX = 4

Positions = Float64[np.ndarray, "rows columns 2"]


def distorted(layer: Layer, overscan: Camera, plate: Camera, distortion: LensDistortion) -> Layer:
    """Return what the overscanned pinhole rendered as the plate's camera sees it; all in focus, blur comes afterwards.

    overscan: `overscan_camera(plate, distortion)`, or any pinhole in the same place that is turned the same way. Colour, alpha
    and extra channels are read by areas, depth is that of the nearest covering pixel, motion is turned and stretched with the
    picture. Work and time grow with the bounding box of the layer. Without distortion, and with one camera, it is the very
    same layer. Light outside the overscanned frame is missing.
    """
    if (layer.height_px, layer.width_px) != (overscan.height_px, overscan.width_px):
        raise InputError(
            f"expected a layer rendered by the overscanned camera, {overscan.width_px}x{overscan.height_px} px, "
            f"got {layer.width_px}x{layer.height_px}"
        )
    same = (overscan.width_px, overscan.height_px, overscan.focal_px, overscan.principal_px)
    if distortion.is_none and same == (plate.width_px, plate.height_px, plate.focal_px, plate.principal_px):
        return layer
    touched = lit_box(layer)
    box = _reached_box(touched, overscan, plate, distortion)
    part = resampled(layer, sampled_positions_px(distortion, plate, overscan, box), touched)
    return box.placed(part, (plate.height_px, plate.width_px))


def _reached_box(box: Box, overscan: Camera, plate: Camera, distortion: LensDistortion) -> Box:
    """Return the plate's pixels that anything in a box of the overscanned picture can reach: those within its warped border."""
    if box.is_empty:
        return NOWHERE
    enlarged = np.asarray(overscan.focal_px) / np.asarray(plate.focal_px)
    pinhole_px = (_border_px(box) - np.asarray(overscan.principal_px)) / enlarged + np.asarray(plate.principal_px)
    border_px = distortion.distorted_px(pinhole_px, plate)
    if not np.isfinite(border_px).all():
        return Box(0, plate.height_px, 0, plate.width_px)
    size = (plate.width_px, plate.height_px)
    left, top = np.clip(np.floor(border_px.min(axis=0)) - _ROOM_PX, 0, size).astype(int).tolist()
    right, bottom = np.clip(np.ceil(border_px.max(axis=0)) + _ROOM_PX, 0, size).astype(int).tolist()
    return Box(top, bottom, left, right) if bottom > top and right > left else NOWHERE


def _border_px(box: Box) -> Float64[np.ndarray, "points 2"]:
    x, y = (
        np.linspace(low, high, (high - low) // _BORDER_STEP_PX + 2)
        for low, high in ((box.left - 1, box.right + 1), (box.top - 1, box.bottom + 1))
    )
    sides = [(x, np.full_like(x, y[0])), (x, np.full_like(x, y[-1])), (np.full_like(y, x[0]), y), (np.full_like(y, x[-1]), y)]
    return np.concatenate([np.stack(side, axis=-1) for side in sides])


def sampled_positions_px(distortion: LensDistortion, plate: Camera, overscan: Camera, box: Box) -> Positions:
    """Return (h + 2, w + 2, 2) where the pixel centres of a box of the plate, and one more on every side, are seen by the pinhole.

    Models are smooth: their inverse is solved every 16 pixels and interpolated by cubic splines, to 1e-3 px. ST maps are read,
    and frames that hold a fold solved, at every pixel.
    """
    x, y = np.arange(box.left - 1, box.right + 1) + 0.5, np.arange(box.top - 1, box.bottom + 1) + 0.5
    if distortion.is_none:
        # The noise of adding and taking off the principal points would mix neighbours.
        return np.round(source_positions_px(distortion, plate, overscan, _grid(x, y)), 9)
    if distortion.st_map is None:
        nodes_x, nodes_y = _nodes(x), _nodes(y)
        coarse = source_positions_px(distortion, plate, overscan, _grid(nodes_x, nodes_y))
        if np.isfinite(coarse).all():
            across, down = _spline(nodes_x, x), _spline(nodes_y, y)
            return np.stack([down @ coarse[..., axis] @ across.T for axis in (0, 1)], axis=-1)
    return source_positions_px(distortion, plate, overscan, _grid(x, y))


def _grid(x: Float64[np.ndarray, " columns"], y: Float64[np.ndarray, " rows"]) -> Positions:
    return np.stack(np.meshgrid(x, y), axis=-1)


def _nodes(positions: Float64[np.ndarray, " n"]) -> Float64[np.ndarray, " nodes"]:
    return np.linspace(positions[0], positions[-1], max(4, -(-len(positions) // GRID_STEP_PX) + 1))


def _spline(nodes: Float64[np.ndarray, " nodes"], positions: Float64[np.ndarray, " n"]) -> Float64[np.ndarray, "n nodes"]:
    """Return the matrix that interpolates values at nodes by a cubic spline (not-a-knot)."""
    from scipy.interpolate import make_interp_spline

    return np.asarray(make_interp_spline(nodes, np.eye(len(nodes)), k=3)(positions))
