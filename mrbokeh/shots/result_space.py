"""The colour space in which a shot is written, where the user names one."""

from dataclasses import replace

from mrbokeh.images.alpha_io import in_named_space
from mrbokeh.images.color_management import NamedSpace
from mrbokeh.images.layer import Layer
from mrbokeh.shots.frame_maker import Picture, Rgba


def in_space(picture: Picture, space: NamedSpace | None) -> Picture:
    """A copy in that space; None leaves linear Rec.709.

    Curves are for straight colour: what has coverage is divided by it before them and multiplied after; light without coverage is lost.
    """
    if isinstance(picture, (Layer, Rgba)):
        return replace(picture, rgb=in_named_space(picture.rgb, picture.alpha, space))
    return in_named_space(picture, None, space)
