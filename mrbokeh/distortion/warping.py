"""A sharp layer of the overscanned pinhole warped into the plate's distorted pixels."""

import numpy as np
from jaxtyping import Float64
from scipy.interpolate import make_interp_spline

from mrbokeh.distortion.distortion import LensDistortion
from mrbokeh.distortion.overscan import GRID_STEP_PX, source_positions_px
from mrbokeh.distortion.resampling import resampled
from mrbokeh.images.layer import Layer
from mrbokeh.layering.pixel_box import NOWHERE, Box, lit_box
from mrbokeh.optics.camera import Camera
from mrbokeh.system.errors import InputError

_ROOM_PX = 3
_BORDER_STEP_PX = 4

Positions = Float64[np.ndarray, "rows columns 2"]


def distorted(layer: Layer, overscan: Camera, plate: Camera, distortion: LensDistortion) -> Layer:
    """What the overscanned pinhole rendered, as the plate's camera sees it; all in focus, blur comes afterwards.

    overscan: `overscan_camera(plate, distortion)`, or any pinhole in the same place that is turned the same way. Colour, alpha
    and extra channels are read by areas, depth is that of the nearest covering pixel, motion is turned and stretched with the
    picture. Work and time go with the box of what the layer touches. Without distortion, and with one camera, it is the very
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
    """The plate's pixels to which anything of a box of the overscanned picture can come: those within its warped border."""
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
    """(h + 2, w + 2, 2): where the pixel centres of a box of the plate, and one more on every side, are seen by the pinhole.

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
    """The matrix that interpolates values at nodes by a cubic spline (not-a-knot)."""
    return np.asarray(make_interp_spline(nodes, np.eye(len(nodes)), k=3)(positions))
