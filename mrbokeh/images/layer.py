"""Layer: one transparent picture with depth, and the premultiplied "over" that stacks them."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float32

from mrbokeh.system.errors import InputError


@dataclass(frozen=True)
class Layer:
    """Scene-linear colour, coverage and depth of one picture.

    rgb: (H, W, 3) linear Rec.709, premultiplied by alpha, unclipped.
    alpha: (H, W) coverage in [0, 1].
    depth_m: (H, W) metres along the optical axis; inf is background.
    extra: further channels by name, each (H, W, E) and premultiplied by alpha like colour (mattes, normals, motion):
    renderers spread them with the same weights as colour, signed and unclipped, so that dividing by alpha gives the mean
    of what is seen. Depth is not spread: it stays that of the sharp layer.
    A scene is a sequence of layers, front first.
    """

    rgb: Float32[np.ndarray, "height width 3"]
    alpha: Float32[np.ndarray, "height width"]
    depth_m: Float32[np.ndarray, "height width"]
    extra: Mapping[str, Float32[np.ndarray, "height width _"]] = field(default_factory=dict)

    def __post_init__(self) -> None:
        size = self.rgb.shape[:2]
        if self.rgb.shape != (*size, 3) or self.alpha.shape != size or self.depth_m.shape != size:
            raise InputError(
                f"a layer needs rgb (H, W, 3) with alpha and depth_m (H, W), "
                f"but came with {self.rgb.shape}, {self.alpha.shape} and {self.depth_m.shape}: resize them to one size"
            )
        for name, values in self.extra.items():
            if values.ndim != 3 or values.shape[:2] != size:
                raise InputError(f"extra channel {name!r} of a layer needs the shape {(*size, 'E')}, but came with {values.shape}")

    @property
    def height_px(self) -> int:
        return self.rgb.shape[0]

    @property
    def width_px(self) -> int:
        return self.rgb.shape[1]


def opaque(rgb: Float32[np.ndarray, "height width 3"], depth_m: Float32[np.ndarray, "height width"]) -> Layer:
    """Return a layer without holes, such as a photograph with its depth map."""
    return Layer(rgb, np.ones_like(depth_m), depth_m)


def clear(height_px: int, width_px: int) -> Layer:
    """Return an empty layer: alpha 0, depth infinite."""
    size = (height_px, width_px)
    return Layer(np.zeros((*size, 3), np.float32), np.zeros(size, np.float32), np.full(size, np.inf, np.float32))


def over(front: Layer, behind: Layer) -> Layer:
    """Lay one premultiplied layer over another (Porter and Duff, Compositing Digital Images, 1984).

    The depth is the front layer's wherever that covers anything at all.
    """
    shines_through = 1.0 - front.alpha
    return Layer(
        rgb=front.rgb + shines_through[..., None] * behind.rgb,
        alpha=front.alpha + shines_through * behind.alpha,
        depth_m=np.where(front.alpha > 0, front.depth_m, behind.depth_m),
        extra={
            name: front.extra.get(name, np.float32(0.0)) + shines_through[..., None] * behind.extra.get(name, np.float32(0.0))
            for name in (*front.extra, *(name for name in behind.extra if name not in front.extra))
        },
    )


def flatten(layers: Sequence[Layer]) -> Layer:
    """Merge layers, front first, into one."""
    if not layers:
        raise InputError("nothing to flatten: expected at least one layer, got none")
    result = layers[-1]
    for front in reversed(layers[:-1]):
        result = over(front, result)
    return result
