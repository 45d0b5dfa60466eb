"""The colour space in which a shot is written, where the user names one."""

from dataclasses import replace

import numpy as np
from jaxtyping import Float32

from mrbokeh.color_management import NamedSpace
from mrbokeh.layer import Layer
from mrbokeh.shots.frame_maker import Picture


def in_space(picture: Picture, space: NamedSpace | None) -> Picture:
    """A copy in that space; None leaves linear Rec.709.

    Curves are for straight colour: a layer is divided by its coverage before them and multiplied after; light without coverage is lost.
    """
    if space is None:
        return picture
    if not isinstance(picture, Layer):
        return space.from_rec709(picture)
    if space.is_linear:
        return replace(picture, rgb=space.from_rec709(picture.rgb))
    return replace(picture, rgb=space.from_rec709(_straight(picture)) * picture.alpha[..., None])


def _straight(layer: Layer) -> Float32[np.ndarray, "height width 3"]:
    alpha = layer.alpha[..., None]
    return np.divide(layer.rgb, alpha, out=np.zeros_like(layer.rgb), where=alpha > 0)
