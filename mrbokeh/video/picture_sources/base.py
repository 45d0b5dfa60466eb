"""PictureSource: the frames of a clip, any stretch of them at once."""

from collections.abc import Iterator
from pathlib import Path
from typing import Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float64

from mrbokeh.images.color_management import NamedSpace
from mrbokeh.video.clip import Frame, VideoInfo


@runtime_checkable
class PictureSource(Protocol):
    """What every source owes (tests/video/test_picture_sources.py asks all of them).

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
        """When each frame is shown, as the file has it."""
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
