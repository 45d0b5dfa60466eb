"""Virtual layers over a photograph: what hides what, then the blur of the lens, then "over"."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from jaxtyping import Float32

from mrbokeh.errors import InputError
from mrbokeh.layer import Layer, flatten
from mrbokeh.lens import Lens
from mrbokeh.renderers.base import Renderer

Rgb = Float32[np.ndarray, "height width 3"]
Plane = Float32[np.ndarray, "height width"]


def occlusion_matte(virtual_depth_m: Plane, photo_depth_m: Plane, tolerance: float = 0.03, softness: float = 0.02) -> Plane:
    """How much of the virtual surface the photographed scene leaves visible: 1 in front of it, 0 behind it.

    Depths are compared by their ratio. The photographed surface must be nearer by more than `tolerance` (a share of the
    depth, the size of the error of depth from focus) to hide the virtual one, so that what stands on it does not sink in;
    over `softness` the matte goes from 1 to 0, so that depth noise does not fray it.
    """
    there = np.isfinite(virtual_depth_m)
    behind_by = np.zeros_like(virtual_depth_m)
    np.divide(virtual_depth_m, photo_depth_m, out=behind_by, where=there)
    matte = np.clip(0.5 + (1.0 + tolerance - behind_by) / softness, 0.0, 1.0)
    return np.where(there, matte, 0.0).astype(np.float32)


def covered_by(layer: Layer, matte: Plane) -> Layer:
    """A layer seen through a matte (H, W) in [0, 1]."""
    return replace(layer, rgb=layer.rgb * matte[..., None], alpha=layer.alpha * matte)


def composite(
    photo_rgb: Rgb, layers: Sequence[Layer], lens: Lens, renderer: Renderer, photo_depth_m: Plane | None = None
) -> tuple[Rgb, Layer]:
    """Virtual layers, front first, put into a photograph; returns (picture, the blurred virtual layer).

    photo_rgb: linear, already blurred by the real lens; it is not blurred again.
    lens: as it was focused when the photograph was taken.
    photo_depth_m: hides what lies behind the photographed scene; None puts the virtual layers in front of everything.
    The occlusion is decided on sharp layers, before the blur (Mandl et al. 2024, Section 3.4).
    """
    for layer in layers:
        _require_size(layer.alpha.shape, photo_rgb.shape[:2], "virtual layer")
    if photo_depth_m is not None:
        _require_size(photo_depth_m.shape, photo_rgb.shape[:2], "depth map of the photograph")
        layers = [covered_by(layer, occlusion_matte(layer.depth_m, photo_depth_m)) for layer in layers]
    blurred = renderer.render(layers, lens) if layers else flatten(layers)
    return lay_over(photo_rgb, blurred), blurred


def lay_over(photo_rgb: Rgb, layer: Layer) -> Rgb:
    """A premultiplied layer over an opaque picture."""
    return layer.rgb + (1.0 - layer.alpha[..., None]) * photo_rgb


def _require_size(size: tuple[int, ...], expected: tuple[int, ...], what: str) -> None:
    if size != expected:
        raise InputError(
            f"the {what} is {size[1]}x{size[0]} px but the photograph is {expected[1]}x{expected[0]} px: render or resize it to that size"
        )
