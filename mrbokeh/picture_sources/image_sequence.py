"""ImageSequence: numbered pictures as the frames of a shot; EXR and HDR are linear, integers of PNG and TIFF are sRGB."""

from collections.abc import Iterator
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path

import numpy as np
from jaxtyping import Float64

from mrbokeh.color_management import NamedSpace
from mrbokeh.errors import InputError
from mrbokeh.image_io import LINEAR_SUFFIXES, read_image
from mrbokeh.picture_sources.numbered_files import NumberedFiles
from mrbokeh.picture_sources.stored_numbers import read_numbers
from mrbokeh.video_color import FULL, VideoColor
from mrbokeh.video_io import Frame, VideoInfo

_LINEAR, _SRGB = 8, 13


@dataclass(frozen=True, eq=False)
class ImageSequence:
    """A PictureSource; frame 0 is the file with the smallest number and is shown at time 0."""

    numbered: NumberedFiles
    info: VideoInfo
    space: NamedSpace | None = None

    @classmethod
    def open(cls, pattern: Path, frame_rate: Fraction, space: NamedSpace | None = None) -> "ImageSequence":
        numbered = NumberedFiles.found(pattern)
        height, width = read_image(numbered.file(0)).shape[:2]
        transfer = _LINEAR if pattern.suffix.lower() in LINEAR_SUFFIXES else _SRGB
        color = VideoColor(matrix=0, code_range=FULL, transfer=transfer, primaries=1)
        return cls(numbered, VideoInfo(width, height, frame_rate, 1 / (frame_rate * 1000), numbered.count, color, 0), space)

    @property
    def path(self) -> Path:
        return self.numbered.pattern

    @property
    def times_s(self) -> Float64[np.ndarray, " frames"]:
        return np.array([float(index / self.info.frame_rate) for index in range(self.numbered.count)])

    @property
    def first_number(self) -> int:
        return self.numbered.first

    def file_of(self, index: int) -> Path | None:
        return self.numbered.file(index)

    def frames(self, start: int, stop: int, threads: int = 0) -> Iterator[Frame]:  # noqa: ARG002
        for index in range(start, stop):
            path = self.numbered.file(index)
            rgb = np.ascontiguousarray(read_image(path) if self.space is None else self.space.to_rec709(read_numbers(path)))
            if rgb.shape[:2] != (self.info.height_px, self.info.width_px):
                size = f"{rgb.shape[1]}x{rgb.shape[0]} px but the sequence began with {self.info.width_px}x{self.info.height_px} px"
                raise InputError(f"{path} is {size}: expected one size throughout")
            yield Frame(rgb, float(index / self.info.frame_rate))
