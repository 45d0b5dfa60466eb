"""PictureSource: the frames of a clip, any stretch of them at once, from a video or from numbered pictures."""

from collections.abc import Iterator
from fractions import Fraction
from pathlib import Path
from typing import Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float64

from mrbokeh.images.color_management import NamedSpace
from mrbokeh.system.errors import InputError
from mrbokeh.video.clip import Frame, VideoInfo
from mrbokeh.video.image_sequence import ImageSequence, is_pattern, pattern_of_folder
from mrbokeh.video.video_source import VideoSource


@runtime_checkable
class PictureSource(Protocol):
    """Source of frames (tests/video/test_picture_sources.py asks all of them).

    It can be pickled and opened again by another process or machine that sees the same files. `frames(i, j)` are the frames that
    reading all of them gives from the i-th on, picture and time, wherever a decoder has to begin for that.
    """

    @property
    def path(self) -> Path:
        """The file, or the pattern of the files."""
        ...

    @property
    def info(self) -> VideoInfo: ...

    @property
    def times_s(self) -> Float64[np.ndarray, " frames"]:
        """Time of each frame, as the file has it."""
        ...

    @property
    def first_number(self) -> int:
        """The number that users know frame 0 by: of the first file of a sequence, 0 of a video."""
        ...

    def file_of(self, index: int) -> Path | None:
        """The picture that frame is stored in, whose metadata may be asked; None of a video."""
        ...

    @property
    def space(self) -> NamedSpace | None:
        """The colour space of its numbers, where the user names it; None is what the files say themselves."""
        ...

    def frames(self, start: int, stop: int, threads: int = 0) -> Iterator[Frame]:
        """Frames from `start` to `stop` (excluded) as linear light, with alpha where `info.has_alpha`.

        threads: of the decoder, 0 takes all.
        """
        ...


def open_source(clip: Path, rate: str | None = None, space: NamedSpace | None = None) -> PictureSource:
    """Open a video, or numbered pictures (a pattern or their folder) with a rate in frames per second ("25", "23.976" or "24000/1001").

    Paths become absolute. space: meaning of the clip's numbers, in place of what its files say.
    """
    clip = pattern_of_folder(clip) if clip.is_dir() else clip
    if is_pattern(clip):
        if rate is None:
            raise InputError(f"{clip}: numbered pictures have no rate of their own: give --rate, such as 25 or 24000/1001")
        return ImageSequence.open(clip.resolve(), parse_rate(rate), space)
    if rate is not None:
        raise InputError(f"--rate is for numbered pictures (frames.%04d.exr), but {clip} has its own times: leave it out")
    if space is not None and space.is_linear:
        raise InputError(
            f"{clip}: the numbers of a video follow a curve, but {space.name} is linear: name the camera's own space (--input-space)"
        )
    return VideoSource.open(clip.resolve(), space)


def parse_rate(text: str) -> Fraction:
    """Frames per second; the usual decimals of NTSC mean the fractions that they stand for."""
    ntsc = {"23.976": 24, "23.98": 24, "29.97": 30, "47.952": 48, "59.94": 60, "119.88": 120}
    if text in ntsc:
        return Fraction(ntsc[text] * 1000, 1001)
    try:
        rate = Fraction(text)
    except (ValueError, ZeroDivisionError):
        rate = Fraction(0)
    if not 0 < rate <= 1000:
        raise InputError(f"expected frames per second such as 25, 23.976 or 24000/1001, got {text!r}")
    return rate
