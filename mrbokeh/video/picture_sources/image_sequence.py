"""ImageSequence: numbered pictures as the frames of a shot; EXR and HDR are linear, integers of PNG and TIFF are sRGB.

Photographs are brought upright as EXIF says. Alpha is read where the first picture holds some; others without it are opaque.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path

import numpy as np
from jaxtyping import Float32, Float64

from mrbokeh.images.alpha_io import is_straight, read_alpha, stores_alpha, straight
from mrbokeh.images.color_management import NamedSpace
from mrbokeh.images.exif import AS_STORED, quarter_turns, stored_orientation, upright
from mrbokeh.images.image_io import LINEAR_SUFFIXES, read_image
from mrbokeh.system.errors import InputError
from mrbokeh.video.clip import Frame, VideoInfo
from mrbokeh.video.color import FULL, VideoColor
from mrbokeh.video.picture_sources.numbered_files import NumberedFiles
from mrbokeh.video.picture_sources.stored_numbers import read_numbers

_LINEAR, _SRGB = 8, 13


@dataclass(frozen=True, eq=False)
class ImageSequence:
    """A PictureSource; frame 0 is the file with the smallest number and is shown at time 0. orientation: EXIF's, of every file."""

    numbered: NumberedFiles
    info: VideoInfo
    space: NamedSpace | None = None
    orientation: int = AS_STORED

    @classmethod
    def open(cls, pattern: Path, frame_rate: Fraction, space: NamedSpace | None = None) -> "ImageSequence":
        numbered = NumberedFiles.found(pattern)
        first = numbered.file(0)
        orientation = stored_orientation(first)
        height, width = upright(read_image(first), orientation).shape[:2]
        transfer = _LINEAR if pattern.suffix.lower() in LINEAR_SUFFIXES else _SRGB
        color = VideoColor(matrix=0, code_range=FULL, transfer=transfer, primaries=1)
        time_base, turned_deg = 1 / (frame_rate * 1000), 90 * quarter_turns(orientation)
        info = VideoInfo(width, height, frame_rate, time_base, numbered.count, color, turned_deg, stores_alpha(first))
        return cls(numbered, info, space, orientation)

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
            self._require_same_way(path)
            yield self._frame(path, float(index / self.info.frame_rate))

    def _frame(self, path: Path, time_s: float) -> Frame:
        """Curves of a space are for straight colour: what is multiplied by alpha is divided before them."""
        alpha, multiplied = self._alpha(path), not is_straight(path)
        if self.space is None:
            rgb = upright(read_image(path), self.orientation)
        else:
            numbers = upright(read_numbers(path), self.orientation)
            if alpha is not None and multiplied and not self.space.is_linear:
                numbers, multiplied = straight(numbers, alpha), False
            rgb = self.space.to_rec709(numbers)
        if rgb.shape[:2] != (self.info.height_px, self.info.width_px):
            size = f"{rgb.shape[1]}x{rgb.shape[0]} px but the sequence began with {self.info.width_px}x{self.info.height_px} px"
            raise InputError(f"{path} is {size}: expected one size throughout")
        return Frame(rgb if alpha is None or multiplied else rgb * alpha[..., None], time_s, alpha)

    def _alpha(self, path: Path) -> Float32[np.ndarray, "height width"] | None:
        """Of an opaque picture among others too, for results are to be alike."""
        if not self.info.has_alpha:
            return None
        stored = read_alpha(path)
        if stored is None:
            return np.ones((self.info.height_px, self.info.width_px), np.float32)
        return upright(stored, self.orientation)

    def _require_same_way(self, path: Path) -> None:
        """The lens is turned once, for all frames."""
        orientation = stored_orientation(path)
        if orientation != self.orientation:
            told = f"EXIF says orientation {orientation} of {path}, but {self.orientation} of {self.numbered.file(0)}"
            raise InputError(f"{told}: expected one way up throughout; turn the pictures themselves, or set the tag alike in all")
