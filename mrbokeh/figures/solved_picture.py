"""A photograph with what was solved of its camera: the grid on the ground, the horizon, and segments coloured by direction."""

from pathlib import Path

import numpy as np
from jaxtyping import Float32, Float64, UInt8

from mrbokeh.images.color import display_rgb8
from mrbokeh.images.picture_codec import write_stored
from mrbokeh.solving.solved_camera import SolvedCamera

WIDEST_PX = 1600
COLOURS = ((255, 80, 70), (70, 210, 90), (70, 140, 255))
"""Colours of segments along x, y and z."""
_GRID, _HORIZON = (255, 225, 40), (255, 60, 220)
_CELLS, _STEPS, _NEAREST = 12, 160, 0.2
_DIMMED = 0.65


def write_solved_picture(path: Path, rgb: Float32[np.ndarray, "height width 3"], camera: SolvedCamera) -> None:
    """Write the picture of a solved camera, at most 1600 px long, as PNG or JPEG."""
    write_stored(path, solved_picture(rgb, camera))


def solved_picture(rgb: Float32[np.ndarray, "height width 3"], camera: SolvedCamera) -> UInt8[np.ndarray, "small_height small_width 3"]:
    """Draw a grid whose cells are as wide as the camera stands high, 12 to each side; x is red, y (upright) green, z blue."""
    import cv2

    shrink = min(1.0, WIDEST_PX / max(rgb.shape[:2]))
    size_px = (max(1, round(rgb.shape[1] * shrink)), max(1, round(rgb.shape[0] * shrink)))
    drawn = display_rgb8(cv2.resize(rgb, size_px, interpolation=cv2.INTER_AREA))
    drawn = np.ascontiguousarray((drawn * _DIMMED).astype(np.uint8))
    thin = max(1, round(max(size_px) / 800))
    for line in _grid_px(camera, size_px):
        cv2.polylines(drawn, [np.round(line * 16).astype(np.int32)], False, _GRID, thin, cv2.LINE_AA, 4)
    scale = size_px[0] / camera.width_px
    for ends, axis in zip(camera.segments_px * scale, camera.axes, strict=True):
        if axis >= 0:
            x1, y1, x2, y2 = (int(value) for value in np.round(ends))
            cv2.line(drawn, (x1, y1), (x2, y2), COLOURS[axis], 2 * thin, cv2.LINE_AA)
    (x1, y1), (x2, y2) = (np.clip(np.multiply(end, scale), -1e5, 1e5).astype(int).tolist() for end in camera.horizon_px)
    cv2.line(drawn, (x1, y1), (x2, y2), _HORIZON, 2 * thin, cv2.LINE_AA)
    return drawn


def _grid_px(camera: SolvedCamera, size_px: tuple[int, int]) -> list[Float64[np.ndarray, "points 2"]]:
    """Return the visible pieces of the grid's lines in pixels of a picture of size (width, height)."""
    seen = camera.camera().resized(*size_px)
    high_m, along = camera.camera_height_m, np.linspace(-_CELLS, _CELLS, _STEPS)
    pieces = []
    for place in range(-_CELLS, _CELLS + 1):
        across = np.full(_STEPS, float(place))
        for x, z in ((across, along), (along, across)):
            points_m = np.stack([x, np.zeros(_STEPS), z], axis=1) * high_m
            with np.errstate(divide="ignore", invalid="ignore"):
                xy_px, depth_m = seen.project(points_m)
            ahead = (depth_m > _NEAREST * high_m) & (np.abs(xy_px).max(axis=1) < 2e4)
            runs = np.split(np.flatnonzero(ahead), np.flatnonzero(np.diff(np.flatnonzero(ahead)) > 1) + 1)
            pieces += [xy_px[run] for run in runs if len(run) > 1]
    return pieces
