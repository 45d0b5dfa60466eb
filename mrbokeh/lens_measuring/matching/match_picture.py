"""The evidence of a matched lens: the discs found, the fitted outlines over them, their mean by region, and the table."""

from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float32, Float64

from mrbokeh.lens_measuring.matching.lens_match import LensMatch
from mrbokeh.lens_measuring.matching.match_table import as_text, table_of

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

REGIONS = (3, 3)
_CROP_PX = 64
_REACH = 1.25  # of a mean disc's picture, in pupil radii

Rgb = Float32[np.ndarray, "height width 3"]


def draw_match(rgb: Rgb, match: LensMatch) -> "Figure":
    """rgb: the photograph, scene-linear."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(14, 8.5), layout="constrained")
    grid = figure.add_gridspec(2, 2, width_ratios=(2.2, 1.0), height_ratios=(2.2, 1.0))
    _draw_photograph(figure.add_subplot(grid[0, 0]), rgb, match)
    _draw_regions(figure.add_subplot(grid[0, 1]), rgb, match)
    axes = figure.add_subplot(grid[1, :])
    axes.axis("off")
    axes.text(0.0, 1.0, as_text(table_of(match)), family="monospace", fontsize=9, va="top", transform=axes.transAxes)
    return figure


def _draw_photograph(axes: "Axes", rgb: Rgb, match: LensMatch) -> None:
    from mrbokeh.images.color import display_rgb8

    height, width = rgb.shape[:2]
    axes.imshow(display_rgb8(np.clip(rgb, 0.0, 1e4)), extent=(0.0, width, height, 0.0))
    kept = {id(disc) for disc in match.discs}
    for disc in match.found:
        axes.plot(*_closed(disc.contour_px).T, color="lime" if id(disc) in kept else "red", lw=0.9)
    for disc, own in zip(match.discs, match.own, strict=True):
        for outline in match.lens.aperture.seen(match.side, disc.field_xy).outlines[:1]:
            axes.plot(*(own[:2] + match.side * own[2] * _closed(outline)).T, color="magenta", lw=0.7, ls="--")
    axes.set_xlim(0.0, width)
    axes.set_ylim(height, 0.0)
    axes.set_title("discs used (green), left out (red), fitted outlines (magenta)", fontsize=9)
    axes.axis("off")


def _closed(outline: Float64[np.ndarray, "points 2"]) -> Float64[np.ndarray, "closed 2"]:
    return np.concatenate([outline, outline[:1]])


def _draw_regions(axes: "Axes", rgb: Rgb, match: LensMatch) -> None:
    """The mean disc of each region of the frame, scaled to one pupil radius and one brightness."""
    columns, rows = REGIONS
    height, width = rgb.shape[:2]
    sheet = np.zeros((rows * _CROP_PX, columns * _CROP_PX), np.float32)
    counts = np.zeros((rows, columns), int)
    for disc, own in zip(match.discs, match.own, strict=True):
        column, row = int(own[0] / width * columns), int(own[1] / height * rows)
        column, row = min(max(column, 0), columns - 1), min(max(row, 0), rows - 1)
        part = (slice(row * _CROP_PX, (row + 1) * _CROP_PX), slice(column * _CROP_PX, (column + 1) * _CROP_PX))
        sheet[part] += _normalised(rgb, own, disc.level)
        counts[row, column] += 1
    sheet /= np.maximum(np.kron(counts, np.ones((_CROP_PX, _CROP_PX))), 1.0).astype(np.float32)
    axes.imshow(np.clip(sheet, 0.0, 1.5), cmap="magma")
    for row, column in np.ndindex(rows, columns):
        axes.text(column * _CROP_PX + 3, row * _CROP_PX + 9, str(counts[row, column]), color="white", fontsize=8)
    axes.set_title("mean disc by region of the frame, and of how many", fontsize=9)
    axes.axis("off")


def _normalised(rgb: Rgb, own: Float64[np.ndarray, "3"], level: float) -> Float32[np.ndarray, "crop crop"]:
    """A disc resampled about its place; OpenCV's first pixel has its centre at (0, 0)."""
    import cv2

    steps = (np.arange(_CROP_PX) + 0.5) / _CROP_PX * 2.0 - 1.0
    x, y = np.meshgrid(own[0] + _REACH * own[2] * steps - 0.5, own[1] + _REACH * own[2] * steps - 0.5)
    grey = np.ascontiguousarray(rgb.max(axis=2))
    return np.asarray(cv2.remap(grey, x.astype(np.float32), y.astype(np.float32), cv2.INTER_LINEAR) / np.float32(level), np.float32)
