"""ColourMatch: from the renderer's light to the photograph's numbers, a gain and a black per channel, in linear light."""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float32

from mrbokeh.images.layer import Layer
from mrbokeh.system.errors import InputError

Triple = tuple[float, float, float]


@dataclass(frozen=True)
class ColourMatch:
    """photograph = gain * light + black.

    gain: per channel (linear Rec.709), above 0: exposure and white balance. black: what the photograph shows where no light is:
    veiling glare of its lens, or a black level set too low.
    """

    gain: Triple = (1.0, 1.0, 1.0)
    black: Triple = (0.0, 0.0, 0.0)

    def __post_init__(self) -> None:
        if not all(np.isfinite(each) and each > 0.0 for each in self.gain):
            raise InputError(f"expected gains above 0 for red, green and blue, got {self.gain}")
        if not all(np.isfinite(each) for each in self.black):
            raise InputError(f"expected finite blacks for red, green and blue, got {self.black}")

    @property
    def is_nothing(self) -> bool:
        return self == ColourMatch()

    def applied(self, layer: Layer) -> Layer:
        """A premultiplied layer in the photograph's numbers: of its black a pixel gets as much as it covers, the rest has it already."""
        return self.lifted(self.gained(layer))

    def gained(self, layer: Layer) -> Layer:
        """The gain alone. Blur sums light with weights of sum 1, so it may come before the blur or after."""
        if self.gain == (1.0, 1.0, 1.0):
            return layer
        return replace(layer, rgb=layer.rgb * _row(self.gain))

    def lifted(self, layer: Layer) -> Layer:
        """The black alone, times alpha."""
        if self.black == (0.0, 0.0, 0.0):
            return layer
        return replace(layer, rgb=layer.rgb + layer.alpha[..., None] * _row(self.black))


def _row(triple: Triple) -> Float32[np.ndarray, "3"]:
    return np.array(triple, np.float32)


def triple_of(values: np.ndarray) -> Triple:
    """Three numbers of an array as they stand in a ColourMatch."""
    red, green, blue = (float(each) for each in values)
    return red, green, blue
