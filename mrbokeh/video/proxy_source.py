"""ProxySource: a clip in fewer pixels, for a look at a shot before its full size."""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from fractions import Fraction
from functools import partial
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Float64

from mrbokeh.images.color_management import NamedSpace
from mrbokeh.system.errors import InputError
from mrbokeh.video.clip import Frame, VideoInfo
from mrbokeh.video.picture_source import PictureSource
from mrbokeh.video.timecode import Timecode


def parse_proxy(text: str | None) -> Fraction:
    """Parse the scale of a proxy, such as 1/2 or 0.25; None is the whole size."""
    try:
        scale = Fraction(text or 1)
    except (ValueError, ZeroDivisionError):
        scale = Fraction(0)
    if not 0 < scale <= 1:
        raise InputError(f"--proxy: expected a part of the plate's width and height such as 1/2 or 1/4, got {text!r}")
    return scale


@dataclass(frozen=True, eq=False)
class ProxySource:
    """A PictureSource of fewer pixels, the mean of the light of those that each stands for."""

    whole: PictureSource
    scale: Fraction

    @classmethod
    def of(cls, whole: PictureSource, scale: Fraction) -> PictureSource:
        return whole if scale == 1 else cls(whole, scale)

    @property
    def path(self) -> Path:
        return self.whole.path

    @property
    def info(self) -> VideoInfo:
        width_px, height_px = (max(1, round(each * self.scale)) for each in (self.whole.info.width_px, self.whole.info.height_px))
        return replace(self.whole.info, width_px=width_px, height_px=height_px)

    @property
    def times_s(self) -> Float64[np.ndarray, " frames"]:
        return self.whole.times_s

    @property
    def first_number(self) -> int:
        return self.whole.first_number

    @property
    def space(self) -> NamedSpace | None:
        return self.whole.space

    def file_of(self, index: int) -> Path | None:
        return self.whole.file_of(index)

    def timecode_of(self, index: int) -> Timecode | None:
        return self.whole.timecode_of(index)

    def frames(self, start: int, stop: int, threads: int = 0) -> Iterator[Frame]:
        info = self.info
        mean = partial(cv2.resize, dsize=(info.width_px, info.height_px), interpolation=cv2.INTER_AREA)
        for frame in self.whole.frames(start, stop, threads):
            yield Frame(mean(frame.rgb), frame.time_s, None if frame.alpha is None else mean(frame.alpha))
