"""Preview of `mrbokeh composite`: a picture of few pixels, over which the ground in metres and what is known of the object are drawn."""

import math
from collections.abc import Iterator, Sequence
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Bool, Float64, UInt8

from mrbokeh.commands._composite_options import CompositeOptions
from mrbokeh.compositing.plate import Inserted, Plate, shrunk
from mrbokeh.images.color import srgb_codes
from mrbokeh.images.layer import Layer
from mrbokeh.images.picture_codec import write_stored

Picture = UInt8[np.ndarray, "height width 3"]

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
    for foot_px in options.standing.pixels:
        plate.require_pixel(*foot_px)
    if scale == 1.0:
        return plate, options, 1.0
    small_px = (max(1, round(scale * width_px)), max(1, round(scale * height_px)))
    return shrunk(plate, *small_px), options.scaled((width_px, height_px), small_px), scale


def write_preview_of(
    out: Path, inserted: Inserted, plate: Plate, objects: Sequence[Layer], heights_m: Sequence[float | None], scale: float
) -> str:
    """Write the picture with the grid on the ground, a box around each object and a line below for each, and return these lines.

    objects: each alone, sharp. heights_m: of each, None where its file tells, which is then measured in the picture.
    scale: of `smaller`; the lines count pixels of the whole photograph.
    """
    drawn, covered = np.ascontiguousarray(srgb_codes(inserted.rgb, np.uint8)), np.maximum.reduce([each.alpha for each in objects]) > 0.5
    told = []
    for number, (each, height_m) in enumerate(zip(objects, heights_m, strict=True)):
        drawn, words = _told(drawn, plate, each, height_m, None if number else covered, scale)
        told.append(words)
    for number, words in enumerate(reversed(told)):
        _write_line(drawn, words, number)
    write_stored(out, drawn)
    return "; ".join(told)


def _told(
    drawn: Picture, plate: Plate, one: Layer, height_m: float | None, covered: Bool[np.ndarray, "height width"] | None, scale: float
) -> tuple[Picture, str]:
    """Return the picture with a box around an object, and what is told of it. covered: by all objects; None draws no grid."""
    rows, columns = np.nonzero(one.alpha > 0.5)
    if not len(rows):
        return drawn, "nothing of the object is larger than a pixel"
    left, top, right, bottom = columns.min(), rows.min(), columns.max(), rows.max()
    seen_m = one.depth_m[rows, columns]
    nearest_m, farthest_m = float(seen_m.min()), float(seen_m[np.isfinite(seen_m)].max())
    foot_m = plate.camera.unproject(np.array([(left + right) / 2 + 0.5, bottom + 1.0]), np.array(float(np.median(seen_m))))
    wanted_m = _CELL_SHARE * plate.length_m(plate.rgb.shape[1], float(foot_m[2]))
    step_m = float(_STEPS_M[np.argmin(np.abs(np.log(_STEPS_M / wanted_m)))])
    if covered is not None:
        over = drawn.copy()
        for line_px in _grid_px(plate, foot_m, step_m):
            cv2.polylines(over, [np.round(line_px * 16).astype(np.int32)], False, _GRID, 1, cv2.LINE_AA, 4)
        drawn = np.where(covered[..., None], drawn, cv2.addWeighted(over, _GRID_SHARE, drawn, 1.0 - _GRID_SHARE, 0.0))
    cv2.rectangle(drawn, (int(left), int(top)), (int(right), int(bottom)), _BOX, 1)
    coc_px = np.abs(plate.lens.coc_px(np.array([nearest_m, farthest_m]), plate.rgb.shape[1])) / scale
    unit = "guessed m" if plate.metres_guessed else "m"
    is_cut = left == 0 or top == 0 or right == one.width_px - 1 or bottom == one.height_px - 1
    high = f"{height_m or plate.length_m(float(bottom - top + 1), float(np.median(seen_m))):.2g} {unit} high"
    told = (
        f"{nearest_m:.3g} to {farthest_m:.3g} {unit} away, {(right - left + 1) / scale:.0f}x{(bottom - top + 1) / scale:.0f} px, "
        f"{'cut off by the frame' if is_cut else high}, blurred by {coc_px.min():.1f} to {coc_px.max():.1f} px"
    )
    return drawn, told if covered is None else f"{told}; cells of {step_m:g} {unit}"


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


def _write_line(drawn: Picture, words: str, number: int) -> None:
    """Write words into a picture, so many lines above its lower edge, smaller where it is narrow."""
    scale = min(_FONT_SCALE, _FONT_SCALE * drawn.shape[1] / (cv2.getTextSize(words, _FONT, _FONT_SCALE, 1)[0][0] + 12))
    below_px = drawn.shape[0] - number * _BAR_PX
    bar = drawn[max(0, below_px - _BAR_PX) : max(0, below_px)]
    bar[...] = (bar * _PAPER).astype(np.uint8)
    cv2.putText(drawn, words, (6, below_px - math.ceil(_BAR_PX * 0.3)), _FONT, scale, _INK, 1, cv2.LINE_AA)
