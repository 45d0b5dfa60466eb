"""Sharp photographed scene cut in two by a virtual surface: what is nearer, with soft edges, and the rest, continued behind it.

A pixel on the edge of a near thing holds both colours; they are separated as mrbokeh.layering.hidden_background does, but at depth
edges alone: where the virtual surface cuts through a smooth surface (a table that an object stands on), the cut is hard. Highlights are
separated from the surfaces that they lie on, since each is seen through one point of the pupil at every place of its blur.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float32, Int64

from mrbokeh.compositing.plate import Plate
from mrbokeh.images.layer import Layer, flatten
from mrbokeh.layering.hidden_background import continued, split_edges
from mrbokeh.layering.highlights import find_highlights, without_highlights
from mrbokeh.layering.padded_layers import PaddedLayer
from mrbokeh.optics.lens import Lens
from mrbokeh.system.resources import workers

_TWO_DEEP = 2.0
_SPECK_PX = 5
_EDGE_PX = 5
_NEAR_EDGE_PX, _FAR_EDGE_PX = 3, 1  # the depth of what is near has a median over 5x5 pixels
_NEIGHBOURS = [(dy, dx) for dy in range(-2, 3) for dx in range(-2, 3)]

Plane = Float32[np.ndarray, "height width"]
Picture = Float32[np.ndarray, "height width 3"]
Mask = Bool[np.ndarray, "height width"]
TOLERANCE = 0.03
"""Share of its depth by which a photographed surface must be nearer to hide a virtual one: the size of the error of depth from focus."""


@dataclass(frozen=True)
class Highlights:
    """Single pixels far brighter than their surroundings: places (row times width plus column), colour and depth."""

    places: Int64[np.ndarray, " highlights"]
    rgb: Float32[np.ndarray, "highlights 3"]
    depth_m: Float32[np.ndarray, " highlights"]


NO_HIGHLIGHTS = Highlights(np.zeros(0, np.int64), np.zeros((0, 3), np.float32), np.zeros(0, np.float32))


@dataclass(frozen=True)
class NearAndFar:
    """Sharp scene in two parts.

    near: premultiplied, sharp, alpha 0 where nothing is near, its depth continued to all places. far_rgb, far_depth_m: opaque, without
    its highlights; depth None: blurred already. highlights: those of what is far.
    """

    near: Layer
    far_rgb: Picture
    far_depth_m: Plane | None
    highlights: Highlights

    @property
    def far(self) -> Layer:
        """Far part as one opaque layer with its highlights; for photographs with depth."""
        assert self.far_depth_m is not None
        layer = Layer(self.far_rgb.copy(), np.ones_like(self.far_depth_m), self.far_depth_m)
        layer.rgb.reshape(-1, 3)[self.highlights.places] += self.highlights.rgb
        return layer


def with_told_depth(plate: Plate, layers: Sequence[Layer]) -> Plate:
    """Return a plate whose depth says what a user's matte with gaps tells: before the virtual surface there, or behind it."""
    if plate.depth_m is None or plate.near_alpha is None or not layers or not np.isnan(plate.near_alpha).any():
        return plate
    virtual_m, beyond = virtual_depth_m(flatten([replace(layer, extra={}) for layer in layers])), np.float32(1.0 + 2.0 * TOLERANCE)
    depth_m = np.where(plate.near_alpha > 0.5, np.minimum(plate.depth_m, virtual_m / beyond), plate.depth_m)
    depth_m = np.where(plate.near_alpha <= 0.5, np.maximum(depth_m, virtual_m * beyond), depth_m)
    return replace(plate, depth_m=depth_m, near_alpha=None)


def nearer_than(depth_m: Plane, virtual_depth_m: Plane, tolerance: float) -> Mask:
    """Return the pixels whose photographed surface lies before the virtual one by more than a share `tolerance` of its depth."""
    return np.isfinite(virtual_depth_m) & (depth_m * np.float32(1.0 + tolerance) < virtual_depth_m)


def cut_in_two(sharp_rgb: Picture, depth_m: Plane, near: Mask, reach_px: float, tolerance: float) -> NearAndFar:
    """Cut a scene in two. reach_px: how far the lens looks past an edge; nothing is inpainted farther behind the near things."""
    rgb = np.ascontiguousarray(sharp_rgb)
    without, places = without_highlights(rgb), np.flatnonzero(find_highlights(rgb))
    places = places[~_brightest_is_near(rgb, near, places)]
    dark = rgb.copy()
    dark.reshape(-1, 3)[places] = without.reshape(-1, 3)[places]
    near_values, far_rgb = _parted(dark, depth_m, near, reach_px, tolerance)
    near_depth_m, far_depth_m = _without_specks(continued(depth_m, near)), continued(depth_m, ~near)
    far_highlights = Highlights(places, (rgb - dark).reshape(-1, 3)[places], far_depth_m.reshape(-1)[places])
    alpha = np.ascontiguousarray(near_values[..., 3])
    return NearAndFar(Layer(np.ascontiguousarray(near_values[..., :3]), alpha, near_depth_m), far_rgb, far_depth_m, far_highlights)


def reach_px(lens: Lens, depth_m: Plane, is_near: Mask) -> float:
    """Return how far the lens looks past the edges of what is near: half of the difference of the circles of confusion there, at most.

    Behind a near thing and before what is far, both continue as they are at the edge (see `continued`).
    """
    if not is_near.any() or is_near.all():
        return 0.0
    coc_px = np.asarray(lens.coc_px(depth_m, depth_m.shape[1]))
    near_px, far_px = coc_px[is_near & _within(_NEAR_EDGE_PX, ~is_near)], coc_px[~is_near & _within(_FAR_EDGE_PX, is_near)]
    return 0.5 * lens.aperture.unit_radius * float(max(far_px.max() - near_px.min(), 0.0))


def _within(distance_px: int, mask: Mask) -> Mask:
    """Return the pixels no farther from the mask than that, along rows and columns."""
    from cv2 import dilate

    return np.asarray(dilate(mask.astype(np.uint8), np.ones((2 * distance_px + 1, 2 * distance_px + 1), np.uint8)) > 0)


def _without_specks(depth_m: Plane) -> Plane:
    """A few pixels of another depth than all around are errors of the depth; blurred apart from their surface they leave holes in it."""
    from cv2 import medianBlur

    return np.asarray(1.0 / medianBlur(np.ascontiguousarray(1.0 / depth_m, np.float32), _SPECK_PX), np.float32)


def _parted(rgb: Picture, depth_m: Plane, near: Mask, reach_px: float, tolerance: float) -> tuple[np.ndarray, Picture]:
    """Return (near (H, W, 4) premultiplied, far (H, W, 3), continued behind the near as far as the lens sees it)."""
    height, width = near.shape
    values = np.ones((height, width, 4), np.float32)
    values[..., :3] = rgb
    step_px = np.float32(_TWO_DEEP * reach_px + _TWO_DEEP)
    with workers(near.size) as pool:
        front, behind = split_edges(PaddedLayer(values, np.where(near, -step_px, np.float32(0.0)), True), pool)
    in_front = front.coc_px.reshape(height, width) < -0.5 * step_px
    near_values = np.where(in_front[..., None], front.values.reshape(height, width, 4), np.float32(0.0))
    far = np.where(in_front[..., None], continued(rgb, ~near), rgb)
    is_far = behind.coc_px > -0.5 * step_px
    far.reshape(-1, 3)[behind.places[is_far]] = behind.values[is_far, :3]
    smooth = without_edge(depth_m, tolerance)
    np.multiply(values, near[..., None], out=near_values, where=smooth[..., None])
    np.copyto(far, rgb, where=(smooth & ~near)[..., None])
    return near_values, far


def without_edge(depth_m: Plane, tolerance: float) -> Mask:
    """Return the pixels around which depth changes by no more than twice the tolerance (a share of it)."""
    from cv2 import dilate, erode

    kernel = np.ones((_EDGE_PX, _EDGE_PX), np.uint8)
    dioptres = np.ascontiguousarray(1.0 / depth_m, np.float32)
    return dilate(dioptres, kernel) <= np.float32(1.0 + 2.0 * tolerance) * erode(dioptres, kernel)


def _brightest_is_near(rgb: Picture, near: Mask, places: Int64[np.ndarray, " highlights"]) -> Bool[np.ndarray, " highlights"]:
    """Return whether the brightest of the 5x5 pixels around each place, the source of its highlight, is near."""
    height, width = near.shape
    rows, columns = places // width, places % width
    brightest, is_near = np.full(len(places), -1.0, np.float32), np.zeros(len(places), bool)
    for dy, dx in _NEIGHBOURS:
        y, x = np.clip(rows + dy, 0, height - 1), np.clip(columns + dx, 0, width - 1)
        brightness = rgb[y, x].sum(axis=1)
        brighter = brightness > brightest
        brightest, is_near = np.where(brighter, brightness, brightest), np.where(brighter, near[y, x], is_near)
    return is_near


def virtual_depth_m(sharp: Layer) -> Plane:
    """Depth of the virtual surface, continued to all places; inf everywhere where there is none."""
    return continued(sharp.depth_m, shows(sharp.rgb, sharp.alpha) & np.isfinite(sharp.depth_m))


def shows_anything(sharp: Layer) -> bool:
    return bool((sharp.alpha > 0).any() or (sharp.rgb > 0).any())


def shows(rgb: Float32[np.ndarray, "height width 3"], alpha: Plane) -> Bool[np.ndarray, "height width"]:
    """Return the pixels at which a layer covers anything or gives light."""
    red, green, blue = (rgb[..., channel] > 0 for channel in range(3))
    return (alpha > 0) | red | green | blue
