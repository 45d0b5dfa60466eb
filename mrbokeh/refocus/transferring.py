"""Transfer: the blur of any lens on a photograph in which all is sharp (Mandl et al. 2024, Section 5)."""

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from jaxtyping import Float32

from mrbokeh.depth.depth_map import DepthMap, DepthSettings
from mrbokeh.depth.open_depth import open_depth
from mrbokeh.depth.phone_depth import read_phone_photo
from mrbokeh.images.color import linear_to_srgb
from mrbokeh.images.layer import Layer, opaque
from mrbokeh.optics.lens import Lens
from mrbokeh.stacks.focal_stack import FocalStack, read_focal_stack
from mrbokeh.stacks.guessed_metres import GUESSED
from mrbokeh.stacks.photograph import Photograph, read_photograph
from mrbokeh.system.errors import InputError

Rgb = Float32[np.ndarray, "height width 3"]

_CLIPPED_FROM, _CLIPPED_AT = 0.97, 0.995


@dataclass(frozen=True)
class SharpPhotograph:
    """photograph: all in focus; depth at its size. focus_m: where a phone had focused, in the unit of its depth, or None.

    stack: the focal stack that it is the all-in-focus picture of, or None.
    """

    photograph: Photograph
    depth: DepthMap
    focus_m: float | None = None
    stack: FocalStack | None = None

    @property
    def layer(self) -> Layer:
        return opaque(self.photograph.rgb, self.depth.depth_m)


def open_sharp(photo: Path, depth: Path | None, settings: DepthSettings) -> SharpPhotograph:
    """depth: None where the photograph itself holds it (a phone's GDepth). Of a phone's photograph with a blurred face the sharp original
    inside is taken, of a merged focal stack its all-in-focus picture and its depth. Raises InputError where there is no depth.
    """
    if photo.is_dir():
        return _of_stack(read_focal_stack(photo), depth, settings)
    phone = read_phone_photo(photo, settings.near_far_m if depth is None else None)
    if phone is None and depth is None:
        raise InputError(f"{photo} holds no depth of its own: give --depth (EXR, PNG, stereo disparity, or a depth network .onnx)")
    photograph = read_photograph(photo)
    if phone is not None and phone.original_rgb is not None:
        photograph = replace(photograph, rgb=phone.original_rgb)
    focus_m = phone.focus.focus_distance_m if phone is not None and phone.focus is not None and depth is None else None
    if focus_m is not None and settings.near_far_m is not None:
        focus_m = None  # in the phone's own unit, which the user replaced
    return SharpPhotograph(photograph, open_depth(depth or photo, photograph.rgb, settings), focus_m)


def _of_stack(stack: FocalStack, depth: Path | None, settings: DepthSettings) -> SharpPhotograph:
    rgb = stack.all_in_focus()
    if depth is not None:
        return SharpPhotograph(Photograph(rgb), open_depth(depth, rgb, settings), stack=stack)
    unit = "metres" if stack.metres_known else GUESSED
    found = DepthMap(stack.depth_m(), stack.depth_valid(), f"of the stack {stack.folder}, {unit}")
    return SharpPhotograph(Photograph(rgb), found, stack=stack)


def seen_like(lens: Lens, photograph: Photograph, photo: Path) -> Lens:
    """The lens with the photograph's field of view at its own f-number, on its own sensor: a longer or shorter sister of it."""
    if photograph.focal_length_mm is None or photograph.sensor_width_mm is None:
        raise InputError(
            f"{photo} does not tell its focal length and sensor: leave --same-view out, or give the lens the focal length wanted"
        )
    return replace(lens, focal_length_mm=lens.sensor_width_mm * photograph.focal_length_mm / photograph.sensor_width_mm)


def with_recovered_highlights(rgb: Rgb, stops: float) -> Rgb:
    """What is clipped at white, taken to be so many stops brighter than it is stored. A guess, which the user makes and not the program.

    Goes over smoothly from codes of 0.97 to 0.995, so that the rim of a highlight does not become a line.
    """
    code = np.clip(linear_to_srgb(rgb.max(axis=2)), 0.0, 1.0)
    clipped = np.clip((code - _CLIPPED_FROM) / (_CLIPPED_AT - _CLIPPED_FROM), 0.0, 1.0)
    return (rgb * (1.0 + clipped * (2.0**stops - 1.0))[..., None]).astype(np.float32)
