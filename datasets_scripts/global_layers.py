"""Global depth layers as in Leimkuehler et al. 2018, Section 6: light is added up linearly within a layer, layers lie over one another.

The layers are those of the sampler: what is far in front of the focus, and everything else as if that were not there. Coverage
goes through the same PSFs as colour; where several PSFs do not add up to 1, colour is weighted anew by it (Lee et al. 2008).
It is plainer than mrbokeh.layering.layering, which cuts every layer into slices: comparisons made with it compare the ways to add up
light, and nothing else.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float32

from mrbokeh.images.image_io import read_layer
from mrbokeh.images.layer import Layer
from mrbokeh.layering.motion import MOTION
from mrbokeh.optics.lens import Lens
from mrbokeh.renderers.bank.tables import Place
from mrbokeh.stacks.exr_layers.render_channels import taken_from_channels

_LEAST = np.float32(1e-6)
_OPAQUE = 0.999


@dataclass(frozen=True)
class GlobalLayer:
    """Light of one layer, continued beyond the frame by a margin where it is opaque.

    values: (H, W, 4) premultiplied R, G, B and coverage. coc_px: (H, W) signed diameters. place: motion, field and depth of each pixel.
    """

    values: Float32[np.ndarray, "height width 4"]
    coc_px: Float32[np.ndarray, "height width"]
    place: Place
    is_opaque: bool


Spread = Callable[[GlobalLayer, int], Float32[np.ndarray, "height width _"]]
"""All light of a layer where it lands within the frame, given the layer and its margin: R, G, B and one coverage or one for each."""


def read_global_layers(folder: Path, lens: Lens, margin_px: int, *, moves: bool = True) -> list[GlobalLayer]:
    """The layers of a set of samples (datasets_scripts.render_samples), front first; moves: False takes them as at rest."""
    return [global_layer(layer, lens, margin_px, moves=moves) for layer in read_moving_layers(folder)]


def read_moving_layers(folder: Path) -> list[Layer]:
    """The layers with their motion as renderers take it, front first."""
    return [taken_from_channels(read_layer(path, extra=True), 1.0) for path in sorted((folder / "layers").glob("*.exr"))]


def global_layer(layer: Layer, lens: Lens, margin_px: int, *, moves: bool = True) -> GlobalLayer:
    """A layer with its motion in pixels, continued beyond the frame as its border pixels do if it covers all of it."""
    covered, is_opaque = layer.alpha > 0, bool(layer.alpha.min() > _OPAQUE)
    motion_px = np.zeros((*covered.shape, 2), np.float32)
    if moves and MOTION in layer.extra:
        motion_px = layer.extra[MOTION] / np.maximum(layer.alpha, _LEAST)[..., None]
    coc_px = np.where(covered, lens.coc_px(layer.depth_m, layer.width_px), 0.0).astype(np.float32)
    depth_m = np.where(covered, layer.depth_m, np.float32(lens.focus_distance_m)).astype(np.float32)
    light = np.dstack([layer.rgb, layer.alpha]).astype(np.float32)
    sides = ((margin_px, margin_px), (margin_px, margin_px))
    values = np.pad(light, (*sides, (0, 0)), mode="edge" if is_opaque else "constant")
    wide_motion_px = np.pad(motion_px.astype(np.float32), (*sides, (0, 0)), mode="edge")
    field_xy = _field_xy(layer.width_px, layer.height_px, margin_px)
    place = Place(wide_motion_px, field_xy, np.pad(depth_m, sides, mode="edge"))
    return GlobalLayer(values, np.pad(coc_px, sides, mode="edge"), place, is_opaque)


def composited(layers: Sequence[GlobalLayer], spread: Spread, margin_px: int) -> Float32[np.ndarray, "height width 3"]:
    """All layers spread and laid over one another, front first; what the last leaves open is shared out."""
    size = [length - 2 * margin_px for length in layers[0].coc_px.shape]
    colour, free = np.zeros((*size, 3)), np.ones((*size, 1))
    for layer in layers:
        light = spread(layer, margin_px)
        weight = np.maximum(light[..., 3:], _LEAST)
        coverage = np.ones_like(weight) if layer.is_opaque else np.clip(light[..., 3:], 0.0, 1.0)
        colour = colour + free * coverage * light[..., :3] / weight
        free = free * (1.0 - coverage)
    return np.maximum(colour / np.maximum(1.0 - free, _LEAST), 0.0).astype(np.float32)


def _field_xy(width_px: int, height_px: int, margin_px: int) -> Float32[np.ndarray, "height width 2"]:
    """Position in half diagonals from the middle of the frame; what lies beyond the frame takes the PSFs of its border."""
    rows, columns = np.indices((height_px + 2 * margin_px, width_px + 2 * margin_px)) + 0.5 - margin_px
    x, y = np.clip(columns, 0, width_px) - 0.5 * width_px, np.clip(rows, 0, height_px) - 0.5 * height_px
    return (np.stack([x, y], axis=2) / (0.5 * np.hypot(width_px, height_px))).astype(np.float32)
