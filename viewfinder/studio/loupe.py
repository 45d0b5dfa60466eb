"""Loupe: a part of the finished picture, one pixel for one of the photograph, composited alone."""

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from jaxtyping import Float32

from mrbokeh.commands._composite_kept import KeptParts
from mrbokeh.commands._composite_layers import objects_of
from mrbokeh.commands._composite_options import CompositeOptions
from mrbokeh.commands._composited import composited, placed
from mrbokeh.compositing.between import COLOURS_REACH_PX
from mrbokeh.compositing.plate import Plate
from mrbokeh.compositing.plate_look.finishing import white_balanced
from mrbokeh.layering.pixel_box import Box, is_same_everywhere
from mrbokeh.optics.camera import camera_of_lens
from mrbokeh.renderers.base import Renderer
from mrbokeh.stacks.photograph import read_photograph
from mrbokeh.system.messages import apart
from viewfinder.studio.photograph import OpenedPhotograph, whole_plate

_MOST_MARGIN_PX, _SPARE_PX = 300, 8


@dataclass(frozen=True)
class Region:
    """Square of the photograph around a pixel, and how far light spreads into it. blur_px: of the preview, its largest diameter."""

    x_px: float
    y_px: float
    side_px: int
    blur_px: float = 0.0


class WholePhotograph:
    """The photograph in all its pixels, read when it is first looked at; half floats take half of the memory."""

    def __init__(self, photograph: OpenedPhotograph) -> None:
        self.photograph = photograph

    @cached_property
    def _read(self) -> tuple[Plate, np.ndarray]:
        """The plate without its light, and that light."""
        path, plate = self.photograph.path, self.photograph.plate
        if plate.rgb.shape[1::-1] != self.photograph.size_px:
            with apart():
                photograph = None if self.photograph.stack else read_photograph(path)
                plate = whole_plate(path, photograph, self.photograph.phone, self.photograph.depth, self.photograph.slice)
        return replace(plate, rgb=np.broadcast_to(np.float32(0.0), plate.rgb.shape)), plate.rgb.astype(np.float16)

    @property
    def dark_plate(self) -> Plate:
        """The plate without its light."""
        return self._read[0]

    def light(self, box: Box) -> Float32[np.ndarray, "height width 3"]:
        """Return the light of a part within the frame."""
        return np.ascontiguousarray(box.of(self._read[1]), dtype=np.float32)


def photographed(whole: WholePhotograph, region: Region) -> Float32[np.ndarray, "side side 3"]:
    """Return the light of a region of the photograph as it is; beyond the frame it is black."""
    seen = _box_of(region)
    shown, wanted = np.zeros((region.side_px, region.side_px, 3), np.float32), seen.within(whole.dark_plate.rgb.shape[:2])
    if not wanted.is_empty:
        shown[wanted.top - seen.top : wanted.bottom - seen.top, wanted.left - seen.left : wanted.right - seen.left] = whole.light(wanted)
    return shown


def _box_of(region: Region) -> Box:
    top, left = (round(each) - region.side_px // 2 for each in (region.y_px, region.x_px))
    return Box(top, top + region.side_px, left, left + region.side_px)


def region_of(whole: WholePhotograph, options: CompositeOptions, kept: KeptParts, region: Region) -> Float32[np.ndarray, "side side 3"]:
    """Return the light of a region as `mrbokeh composite` makes it, but for grain and for a shadow's end at an edge of the ground.

    kept: with the light of the preview, which a part of the picture cannot tell. Beyond the frame it is black.
    """
    with apart():
        plate, renderer, options = _standing(whole, options)
    height_px, width_px = plate.rgb.shape[:2]
    margin_px = min(_MOST_MARGIN_PX, int(region.blur_px / 2) + _SPARE_PX) + (0 if plate.near_alpha is None else COLOURS_REACH_PX)
    seen = _box_of(region)
    # Cat's eyes and the like depend on the place in the frame.
    grown = seen.grown(margin_px) if is_same_everywhere(plate.lens) else Box(0, height_px, 0, width_px)
    box = grown.within((height_px, width_px))
    shown = np.zeros((region.side_px, region.side_px, 3), np.float32)
    if box.is_empty:
        return shown
    part = replace(
        plate,
        rgb=whole.light(box),
        depth_m=_part_of(plate.depth_m, box),
        depth_confidence=_part_of(plate.depth_confidence, box),
        sharp_rgb=_part_of(plate.sharp_rgb, box),
        near_alpha=_part_of(plate.near_alpha, box),
        alpha=None,
        lens=box.lens_of(plate.lens, width_px),
        camera=box.camera_of(plate.camera),
    )
    with apart():
        light = composited(part, options, renderer, white_balanced(options.look.wanted), kept=kept).inserted.rgb
    wanted = seen.within((height_px, width_px))
    inner = light[wanted.top - box.top : wanted.bottom - box.top, wanted.left - box.left : wanted.right - box.left]
    shown[wanted.top - seen.top : wanted.bottom - seen.top, wanted.left - seen.left : wanted.right - seen.left] = inner
    return shown


def _part_of(plane: np.ndarray | None, box: Box) -> np.ndarray | None:
    return None if plane is None else np.ascontiguousarray(box.of(plane))


def _standing(whole: WholePhotograph, options: CompositeOptions) -> tuple[Plate, Renderer, CompositeOptions]:
    """Return the whole plate with its lens, and the options with the object's place in metres, which a part of the picture shares."""
    small, renderer, known_height_m = whole.photograph.upright(options, 1e5)
    plate = replace(
        whole.dark_plate,
        lens=small.lens,
        camera=camera_of_lens(small.lens, *whole.photograph.size_px),
        world_from_camera=small.world_from_camera,
        near_alpha=None if options.taken.matte is None else whole.photograph.whole_matte(options.taken.matte),
        focus_known=small.focus_known,
        view_known=small.view_known,
    )
    plate, options = placed(plate, options, known_height_m)
    standing = options.standing
    if standing.at_pixel:
        places = [",".join(f"{each:.9g}" for each in one.stands_at_m) for one in objects_of(standing, plate)]
        standing = replace(standing, at=places, at_pixel=None)
    return plate, renderer, replace(options, standing=standing)
