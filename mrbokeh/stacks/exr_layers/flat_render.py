"""A render of another program, RGBA with Z, as one layer; and the protocol of all ways of reading a file.

Z is that of one ray, which may have passed by what covers part of the pixel: depth at edges is mended from the nearest known pixel.
"""

from pathlib import Path
from typing import Protocol, runtime_checkable

import numpy as np
from jaxtyping import Bool, Float32

from mrbokeh.images.exr_io import in_rec709
from mrbokeh.images.image_io import require_depth_ahead, require_numbers
from mrbokeh.images.layer import Layer
from mrbokeh.stacks.exr_layers.render_channels import BACKGROUND_FROM, RenderChannels, joined

# The eight neighbours.
_BESIDE_PX = 1.5


def edges_mended(layer: Layer) -> Layer:
    """Give partly covered pixels without depth that of a pixel beside them. Opaque ones without depth are sky and stay."""
    is_known = np.isfinite(layer.depth_m)
    is_lost = ~is_known & (layer.alpha > 0) & (layer.alpha < 1)
    if not is_lost.any() or not is_known.any():
        return layer
    nearest_m, distance_px = nearest_depth(layer.depth_m, is_known)
    depth_m = np.where(is_lost & (distance_px < _BESIDE_PX), nearest_m, layer.depth_m)
    return Layer(layer.rgb, layer.alpha, depth_m, layer.extra)


def nearest_depth(
    depth_m: Float32[np.ndarray, "height width"], is_known: Bool[np.ndarray, "height width"]
) -> tuple[Float32[np.ndarray, "height width"], np.ndarray]:
    """Return the depth of the nearest known pixel, and how far away that is, in pixels; at least one must be known."""
    from scipy.ndimage import distance_transform_edt

    distance_px, (rows, columns) = distance_transform_edt(~is_known, return_indices=True)
    return depth_m[rows, columns], distance_px


@runtime_checkable
class LayerReader(Protocol):
    """Way of reading one file of a render; its settings are its constructor's."""

    def layers(self, path: Path | str) -> list[Layer]:
        """Return sharp layers, front first, linear Rec.709, depth in metres. Raises InputError if the file lacks what is asked for."""
        ...


class FlatRender:
    """Reader of a flat render: premultiplied colour, depth along the axis in metres."""

    def layers(self, path: Path | str) -> list[Layer]:
        """Return the one layer; pixels at edges whose depth is that of the background behind are mended."""
        return [edges_mended(layer_of(RenderChannels.read(path)))]


def layer_of(render: RenderChannels) -> Layer:
    """Return the picture of channels, without mending depth at edges. Colour above alpha is light of its own (flames) and stays as it is.

    Depths not above 0 or farther than any scene are background.
    """
    name = render.colour_layer()
    rgb = np.stack([render.plane(joined(name, each)) for each in "RGB"], axis=2).astype(np.float32)
    alpha_name = joined(name, "A")
    alpha = render.plane(alpha_name).astype(np.float32) if alpha_name in render.channels else np.ones(rgb.shape[:2], np.float32)
    require_numbers(render.path, {"colour": rgb, "alpha": alpha})
    rgb = in_rec709(rgb, render.primaries, render.path)
    depth_name, is_seen = render.depth_name(name), (alpha > 0) | (rgb != 0).any(axis=2)
    depth_m = render.plane(depth_name).astype(np.float32)
    require_depth_ahead(render.path, depth_name, render.plane(depth_name)[is_seen])
    require_numbers(render.path, {depth_name: depth_m})
    is_there = is_seen & (depth_m > 0) & (depth_m < BACKGROUND_FROM)
    return Layer(rgb, alpha, np.where(is_there, depth_m, np.float32(np.inf)))
