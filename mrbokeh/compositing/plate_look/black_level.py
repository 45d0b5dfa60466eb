"""Lifted blacks: what a photograph shows where the scene sends no light (veiling glare, a black level set too low)."""

import numpy as np
from jaxtyping import Float32

from mrbokeh.compositing.plate_look.colour_match import Triple, triple_of
from mrbokeh.compositing.plate_look.grey_card import PixelBox, patch_colour
from mrbokeh.system.errors import InputError

Picture = Float32[np.ndarray, "height width 3"]


def picked_black(plate_rgb: Picture, box: PixelBox) -> Triple:
    """The colour of a patch that the user knows to be black (a hole, a lens cap's edge)."""
    return patch_colour(plate_rgb, box)


def darkest_black(plate_rgb: Picture, darkest_share: float = 0.002, block_px: int = 4) -> Triple:
    """The level that the darkest blocks of each channel have, not below 0 (dark-object subtraction, Chavez 1988).

    It is an upper bound: a scene need not hold anything black. Blocks are averaged first, for the darkest single pixels would be
    those that noise made dark; their darkest_share then gives a quantile, for a few dead pixels must not decide.
    """
    height, width = (length // block_px * block_px for length in plate_rgb.shape[:2])
    if not height or not width:
        raise InputError(f"expected a photograph of {block_px}x{block_px} px or more, got {plate_rgb.shape[1]}x{plate_rgb.shape[0]} px")
    cut = plate_rgb[:height, :width].reshape(height // block_px, block_px, width // block_px, block_px, 3)
    means = cut.mean(axis=(1, 3), dtype=np.float64).reshape(-1, 3)
    return triple_of(np.maximum(np.quantile(means, darkest_share, axis=0), 0.0))
