"""ColourMatch: from the renderer's light to the photograph's numbers, a gain and a black per channel, in linear light.

The gain comes from a patch of known reflectance, such as a grey card; the black from lifted blacks, which a photograph shows where the
scene sends no light (veiling glare, a black level set too low).
"""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float32

from mrbokeh.images.layer import Layer
from mrbokeh.system.errors import InputError
from mrbokeh.system.typed_numbers import numbers_in

Triple = tuple[float, float, float]

Picture = Float32[np.ndarray, "height width 3"]
GREY_CARD = 0.18
_MOST_CLIPPED, _NEARLY_WHITE = 0.1, 0.95
_DARKEST_SHARE, _BLOCK_PX = 0.002, 4


@dataclass(frozen=True)
class ColourMatch:
    """Match by photograph = gain * light + black.

    gain: per channel (linear Rec.709), above 0: exposure and white balance. black: number of the photograph without any light: veiling
    glare of its lens, or a black level set too low.
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


@dataclass(frozen=True)
class PixelBox:
    """A square of pixels around (x_px, y_px), reaching radius_px to each side of that pixel."""

    x_px: int
    y_px: int
    radius_px: int = 8

    @classmethod
    def parse(cls, text: str, option: str = "--match-grey") -> "PixelBox":
        """ "X,Y" or "X,Y,R" in whole pixels. Raises InputError."""
        expected = f"{option}: expected X,Y or X,Y,RADIUS in whole pixels, such as 812,430,12"
        numbers = numbers_in(text, expected, (2, 3), number=int)
        if min(numbers) < 0:
            raise InputError(f"{expected}, got {text!r}")
        return cls(*numbers)

    def of(self, picture: Picture) -> Float32[np.ndarray, "rows columns 3"]:
        """Return that part of a picture. Raises InputError if it does not lie within."""
        height, width = picture.shape[:2]
        if not (self.radius_px <= self.x_px < width - self.radius_px and self.radius_px <= self.y_px < height - self.radius_px):
            raise InputError(
                f"expected a patch within the photograph of {width}x{height} px, got {self.radius_px} px around {self.x_px},{self.y_px}: "
                f"pick another pixel or a smaller radius"
            )
        rows = slice(self.y_px - self.radius_px, self.y_px + self.radius_px + 1)
        return picture[rows, self.x_px - self.radius_px : self.x_px + self.radius_px + 1]


def patch_colour(picture: Picture, box: PixelBox) -> Triple:
    """The mean of the middle half of a patch's values, per channel: grain averages out, a scratch or a speck does not count.

    Raises InputError where the patch is clipped, for then nobody knows its colour.
    """
    patch = box.of(picture).reshape(-1, 3)
    clipped = (patch >= np.maximum(picture.reshape(-1, 3).max(axis=0), _NEARLY_WHITE)).mean(axis=0).max()
    if clipped > _MOST_CLIPPED:
        raise InputError(
            f"the patch around {box.x_px},{box.y_px} is clipped in {clipped:.0%} of its pixels: pick one that is darker in the photograph"
        )
    ordered = np.sort(patch.astype(np.float64), axis=0)
    quarter = len(ordered) // 4
    return triple_of(ordered[quarter : len(ordered) - quarter].mean(axis=0))


def grey_card_match(
    plate_rgb: Picture,
    box: PixelBox,
    *,
    rendered: Triple | float = GREY_CARD,
    black: Triple = (0.0, 0.0, 0.0),
    falloff: Triple = (1.0, 1.0, 1.0),
) -> ColourMatch:
    """The gain that makes the renderer's card the photograph's.

    rendered: what the renderer gives the same card in the same place, or just its reflectance, which is that under light that
    gives a white surface 1. black: of the photograph (plate_look.black_level). falloff: the lens's at the patch, so that the
    gain is that of the middle of the frame (mrbokeh.compositing.plate_look.vignetting).
    """
    card = np.broadcast_to(np.asarray(rendered, np.float64), 3)
    light = np.array(patch_colour(plate_rgb, box)) - black
    if not (card > 0.0).all():
        raise InputError(f"expected the card's rendered value above 0 in every channel, got {triple_of(card)}")
    if not (light > 0.0).all():
        raise InputError(
            f"expected the patch around {box.x_px},{box.y_px} to be brighter than the photograph's black, "
            f"got {triple_of(light)} above it: pick the card itself"
        )
    return ColourMatch(triple_of(light / card / falloff), black)


def darkest_black(plate_rgb: Picture) -> Triple:
    """The level that the darkest blocks of each channel have, not below 0 (dark-object subtraction, Chavez 1988).

    It is an upper bound: a scene need not hold anything black. Blocks are averaged first, for the darkest single pixels would be
    those that noise made dark; then a quantile is taken, for a few dead pixels must not decide.
    """
    height, width = (length // _BLOCK_PX * _BLOCK_PX for length in plate_rgb.shape[:2])
    if not height or not width:
        raise InputError(f"expected a photograph of {_BLOCK_PX}x{_BLOCK_PX} px or more, got {plate_rgb.shape[1]}x{plate_rgb.shape[0]} px")
    cut = plate_rgb[:height, :width].reshape(height // _BLOCK_PX, _BLOCK_PX, width // _BLOCK_PX, _BLOCK_PX, 3)
    means = cut.mean(axis=(1, 3), dtype=np.float64).reshape(-1, 3)
    return triple_of(np.maximum(np.quantile(means, _DARKEST_SHARE, axis=0), 0.0))
