"""Preview of `mrbokeh composite`: a picture of few pixels, over which the ground in metres and what is known of the object are drawn."""

import math
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Float64, UInt8

from mrbokeh.commands._composite_options import CompositeOptions
from mrbokeh.commands._level_ground import pair_of
from mrbokeh.compositing.plate import Inserted, Plate, shrunk
from mrbokeh.images.color import srgb_codes
from mrbokeh.images.layer import Layer
from mrbokeh.images.picture_codec import write_stored

_LONGEST_PX = 1000
_CELLS, _POINTS, _NEAREST = 12, 97, 0.05
_STEPS_M = np.outer(10.0 ** np.arange(-3, 4), (1.0, 2.0, 5.0)).ravel()
_CELL_SHARE = 0.12
"""Width of a cell of the grid, in widths of the picture where the object stands."""
_GRID, _BOX, _INK, _PAPER, _GRID_SHARE = (255, 225, 40), (60, 230, 255), (255, 255, 255), 0.35, 0.6
_BAR_PX, _FONT, _FONT_SCALE = 24, cv2.FONT_HERSHEY_SIMPLEX, 0.5


def smaller(plate: Plate, options: CompositeOptions) -> tuple[Plate, CompositeOptions, float]:
    """Return the plate with at most 1000 px along its longer side, the options in its pixels, and how many of them one pixel was."""
    height_px, width_px = plate.rgb.shape[:2]
    scale = min(1.0, _LONGEST_PX / max(height_px, width_px))
    if options.standing.at_pixel is not None:
        plate.require_pixel(*pair_of(options.standing.at_pixel))
    if scale == 1.0:
        return plate, options, 1.0
    small_px = (max(1, round(scale * width_px)), max(1, round(scale * height_px)))
    return shrunk(plate, *small_px), options.scaled((width_px, height_px), small_px), scale


def write_preview_of(out: Path, inserted: Inserted, plate: Plate, objects: Layer, scale: float) -> str:
    """Write the picture with the grid on the ground, a box around the object and a line below, and return that line.

    objects: the object alone, sharp. scale: of `smaller`; the line counts pixels of the whole photograph.
    """
    drawn = np.ascontiguousarray(srgb_codes(inserted.rgb, np.uint8))
    rows, columns = np.nonzero(objects.alpha > 0.5)
    if not len(rows):
        write_stored(out, drawn)
        return "nothing of the object is larger than a pixel"
    left, top, right, bottom = columns.min(), rows.min(), columns.max(), rows.max()
    seen_m = objects.depth_m[rows, columns]
    nearest_m, farthest_m = float(seen_m.min()), float(seen_m[np.isfinite(seen_m)].max())
    foot_m = plate.camera.unproject(np.array([(left + right) / 2 + 0.5, bottom + 1.0]), np.array(float(np.median(seen_m))))
    wanted_m = _CELL_SHARE * plate.length_m(plate.rgb.shape[1], float(foot_m[2]))
    step_m = float(_STEPS_M[np.argmin(np.abs(np.log(_STEPS_M / wanted_m)))])
    over = drawn.copy()
    for line_px in _grid_px(plate, foot_m, step_m):
        cv2.polylines(over, [np.round(line_px * 16).astype(np.int32)], False, _GRID, 1, cv2.LINE_AA, 4)
    drawn = np.where((objects.alpha > 0.5)[..., None], drawn, cv2.addWeighted(over, _GRID_SHARE, drawn, 1.0 - _GRID_SHARE, 0.0))
    cv2.rectangle(drawn, (int(left), int(top)), (int(right), int(bottom)), _BOX, 1)
    coc_px = np.abs(plate.lens.coc_px(np.array([nearest_m, farthest_m]), plate.rgb.shape[1])) / scale
    unit = "guessed m" if plate.metres_guessed else "m"
    is_cut = left == 0 or top == 0 or right == objects.width_px - 1 or bottom == objects.height_px - 1
    high = f"{plate.length_m(float(bottom - top + 1), float(np.median(seen_m))):.2g} {unit} high"
    told = (
        f"{nearest_m:.3g} to {farthest_m:.3g} {unit} away, {(right - left + 1) / scale:.0f}x{(bottom - top + 1) / scale:.0f} px, "
        f"{'cut off by the frame' if is_cut else high}, blurred by {coc_px.min():.1f} to {coc_px.max():.1f} px; cells of {step_m:g} {unit}"
    )
    write_stored(out, _with_line(drawn, told))
    return told


def _grid_px(plate: Plate, foot_m: Float64[np.ndarray, "3"], step_m: float) -> Iterator[Float64[np.ndarray, "points 2"]]:
    """Yield the visible pieces of lines on the level plane through a place, in camera axes, which cross there."""
    upright = np.eye(3) if plate.world_from_camera is None else plate.world_from_camera
    along = np.linspace(-_CELLS, _CELLS, _POINTS)
    for place in range(-_CELLS, _CELLS + 1):
        for right, ahead in ((np.full(_POINTS, place), along), (along, np.full(_POINTS, place))):
            points_m = foot_m + step_m * np.stack([right, np.zeros(_POINTS), ahead], axis=1) @ upright
            shown = points_m[points_m[:, 2] > _NEAREST * foot_m[2]]
            if len(shown) > 1:
                yield (shown[:, :2] / shown[:, 2:] * plate.camera.focal_px + plate.camera.principal_px).clip(-1e4, 1e4)


def _with_line(drawn: UInt8[np.ndarray, "height width 3"], words: str) -> UInt8[np.ndarray, "height width 3"]:
    """Return the picture with words at its lower edge, smaller where it is narrow."""
    scale = min(_FONT_SCALE, _FONT_SCALE * drawn.shape[1] / (cv2.getTextSize(words, _FONT, _FONT_SCALE, 1)[0][0] + 12))
    bar = drawn[-_BAR_PX:]
    bar[...] = (bar * _PAPER).astype(np.uint8)
    cv2.putText(drawn, words, (6, drawn.shape[0] - math.ceil(_BAR_PX * 0.3)), _FONT, scale, _INK, 1, cv2.LINE_AA)
    return drawn
