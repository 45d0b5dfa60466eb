"""A render of another program, RGBA with Z and perhaps motion, as one layer; and the protocol of all ways of reading a file.

Z is that of one ray, which may have passed by what covers part of the pixel: depth at edges is mended from the nearest known pixel.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Literal, Protocol, get_args, runtime_checkable

import numpy as np
from jaxtyping import Bool, Float32

from mrbokeh.images.exr_io import in_rec709
from mrbokeh.images.image_io import require_depth_ahead, require_numbers
from mrbokeh.images.layer import Layer
from mrbokeh.layering.motion import with_motion
from mrbokeh.optics.camera import Camera
from mrbokeh.stacks.exr_layers.render_channels import BACKGROUND_FROM, RenderChannels, joined
from mrbokeh.system.errors import InputError

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


DepthMeaning = Literal["axis", "inverse", "distance"]


@dataclass(frozen=True)
class FlatRender:
    """Reader of a flat render. Nothing about its channels is guessed from the numbers.

    One thing is mended: pixels at edges whose depth is that of the background behind.

    layer, depth: names of the colour layer and the depth channel if the known ones (render_channels) do not fit.
    view: of stereo files.
    depth_is: "axis" along the optical axis; "inverse" one over that (Nuke); "distance" along the ray, which needs the camera.
    metres_per_unit: of the depth; 0.01 for a scene in centimetres.
    premultiplied: False multiplies colour by alpha. Colour above alpha is light of its own (flames) and stays as it is.
    shutter: which part of a frame the shutter is open, for motion blur from the file's motion; 0 leaves motion unread.
    """

    layer: str | None = None
    depth: str | None = None
    view: str = ""
    depth_is: DepthMeaning = "axis"
    metres_per_unit: float = 1.0
    premultiplied: bool = True
    shutter: float = 0.0
    camera: Camera | None = None

    def __post_init__(self) -> None:
        if self.depth_is not in get_args(DepthMeaning):
            raise InputError(f"depth can be {', '.join(get_args(DepthMeaning))}, not {self.depth_is!r}")
        if self.depth_is == "distance" and self.camera is None:
            raise InputError("depth as a distance along the ray needs the camera that rendered it: give one")
        if not self.metres_per_unit > 0:
            raise InputError(f"metres per unit of depth must be above 0, got {self.metres_per_unit}")

    def layers(self, path: Path | str) -> list[Layer]:
        return [edges_mended(self.layer_of(RenderChannels.read(path, self.view)))]

    def layer_of(self, render: RenderChannels) -> Layer:
        """Return the picture of channels that were read already, without mending depth at edges."""
        name = render.colour_layer(self.layer)
        rgb = np.stack([render.plane(joined(name, each)) for each in "RGB"], axis=2).astype(np.float32)
        alpha_name = joined(name, "A")
        alpha = render.plane(alpha_name).astype(np.float32) if alpha_name in render.channels else np.ones(rgb.shape[:2], np.float32)
        require_numbers(render.path, {"colour": rgb, "alpha": alpha})
        rgb = in_rec709(rgb, render.primaries, render.path)
        rgb = rgb if self.premultiplied else rgb * alpha[..., None]
        depth_name, is_seen = render.depth_name(name, self.depth), (alpha > 0) | (rgb != 0).any(axis=2)
        require_depth_ahead(render.path, depth_name, render.plane(depth_name)[is_seen])
        depth_m = self._depth_m(render, depth_name)
        layer = Layer(rgb, alpha, np.where(is_seen, depth_m, np.float32(np.inf)))
        return self._moving(layer, render, name) if self.shutter > 0 else layer

    def _depth_m(self, render: RenderChannels, name: str) -> Float32[np.ndarray, "height width"]:
        """Return metres along the axis; values not above 0 or farther than any scene are background."""
        stored = render.plane(name).astype(np.float32)
        require_numbers(render.path, {name: stored})
        if self.depth_is == "inverse":
            stored = np.divide(1.0, stored, out=np.full_like(stored, np.inf), where=stored > 0)
        is_there = (stored > 0) & (stored < BACKGROUND_FROM)
        depth_m = np.where(is_there, stored * np.float32(self.metres_per_unit), np.float32(np.inf))
        return depth_m if self.camera is None or self.depth_is != "distance" else depth_m * _axis_share(self.camera, stored.shape)

    def _moving(self, layer: Layer, render: RenderChannels, name: str) -> Layer:
        names = render.motion_names(name)
        right, up = (names.factor * render.plane(each).astype(np.float32) for each in (names.right, names.up))
        motion_px = np.stack([right, -up], axis=2).astype(np.float32)
        require_numbers(render.path, {names.right: motion_px[layer.alpha > 0]})
        return with_motion(layer, motion_px, self.shutter)


def _axis_share(camera: Camera, size: tuple[int, ...]) -> Float32[np.ndarray, "height width"]:
    """Return the depth along the axis of a point at distance 1 along each pixel's ray."""
    if size != (camera.height_px, camera.width_px):
        raise InputError(
            f"the camera is {camera.width_px}x{camera.height_px} px but the render is {size[1]}x{size[0]} px: give its own camera"
        )
    plane = (camera.pixel_centres_px() - camera.principal_px) / np.asarray(camera.focal_px)
    return (1.0 / np.sqrt(1.0 + (plane**2).sum(axis=2))).astype(np.float32)
