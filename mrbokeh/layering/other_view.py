"""Another view of the same scene, moved into this camera: what lies behind the edges of a picture need not be guessed."""

import numpy as np
from jaxtyping import Float32, Int

from mrbokeh.images.layer import Layer
from mrbokeh.optics.camera import Camera
from mrbokeh.system.errors import InputError

_CLOSED_BY = 5
_SAME_DEPTH = 0.02


def layer_from_view(
    rgb: Float32[np.ndarray, "height width 3"],
    depth_m: Float32[np.ndarray, "height width"],
    view: Camera,
    camera: Camera,
    shown_depth_m: Float32[np.ndarray, "rows columns"] | None = None,
) -> Layer:
    """The opaque picture (scene-linear) with its depth (metres; inf is left out) that `view` took, as a layer of `camera`.

    shown_depth_m: depth of the picture that `camera` took; then only what lies behind that is kept, 2 % at least.
    Every pixel goes to the one pixel that its point falls on, and the nearest point wins; holes of single pixels, as
    enlarging leaves them, take the mean of neighbours at their depth. To be listed behind the picture of `camera`.
    """
    if depth_m.shape != (view.height_px, view.width_px):
        raise InputError(
            f"the other view has {depth_m.shape[::-1]} px, but its camera {view.width_px}x{view.height_px}: resize one of them"
        )
    usable = np.isfinite(depth_m) & (depth_m > 0)
    points_m = view.unproject(view.pixel_centres_px()[usable], depth_m[usable].astype(np.float64))
    xy_px, z_m = camera.project(points_m)
    column, row = (np.floor(xy_px[:, i]).astype(np.int64) for i in (0, 1))
    inside = (z_m > 0) & (column >= 0) & (column < camera.width_px) & (row >= 0) & (row < camera.height_px)
    if shown_depth_m is not None:
        inside[inside] = z_m[inside] > shown_depth_m[row[inside], column[inside]] * (1.0 + _SAME_DEPTH)
    colours = np.zeros((camera.height_px * camera.width_px, 3), np.float32)
    depths_m = np.full(len(colours), np.inf, np.float32)
    target, nearest = _nearest((row * camera.width_px + column)[inside], z_m[inside])
    colours[target], depths_m[target] = rgb[usable][inside][nearest], z_m[inside][nearest]
    size = camera.height_px, camera.width_px
    return _closed(colours.reshape(*size, 3), depths_m.reshape(size))


def _nearest(target: Int[np.ndarray, " points"], z_m: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Each target pixel once, and which of its points is the nearest."""
    order = np.lexsort((z_m, target))
    first = np.concatenate([[True], np.diff(target[order]) != 0])[: len(order)]
    return target[order][first], order[first]


def _closed(rgb: Float32[np.ndarray, "height width 3"], depth_m: Float32[np.ndarray, "height width"]) -> Layer:
    """Holes with at least 5 of 8 neighbours, all about as deep as the nearest of them, become their mean."""
    around = np.stack([np.roll(depth_m, (dy, dx), (0, 1)) for dy in (-1, 0, 1) for dx in (-1, 0, 1) if (dy, dx) != (0, 0)])
    colours = np.stack([np.roll(rgb, (dy, dx), (0, 1)) for dy in (-1, 0, 1) for dx in (-1, 0, 1) if (dy, dx) != (0, 0)])
    alike = around <= around.min(axis=0) * (1.0 + _SAME_DEPTH)
    alike &= np.isfinite(around)
    hole = np.isinf(depth_m) & (alike.sum(axis=0) >= _CLOSED_BY)
    count = np.maximum(alike.sum(axis=0), 1)
    depth_m = np.where(hole, np.where(alike, around, 0.0).sum(axis=0) / count, depth_m).astype(np.float32)
    rgb = np.where(hole[..., None], np.where(alike[..., None], colours, 0.0).sum(axis=0) / count[..., None], rgb).astype(np.float32)
    return Layer(rgb, np.isfinite(depth_m).astype(np.float32), depth_m)
