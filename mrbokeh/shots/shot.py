"""Shot: a stretch of a clip, the recipe of its frames and their target; cut into segments that can be rendered independently."""

from collections.abc import Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple, Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float32

from mrbokeh.images.layer import Layer
from mrbokeh.video.picture_source import PictureSource

SEGMENT_S = 2.0
"""Long enough that decoding from the keyframe before and a keyframe more cost little, short enough that a kill loses little."""

MANIFEST = "manifest.json"
"""In the folder of the parts: what they were made with."""


class Segment(NamedTuple):
    """Frames of the clip, counted from its first, in their order; number: its place in the shot."""

    number: int
    taken: Sequence[int]


@dataclass(frozen=True)
class Rgba:
    """A finished picture that does not cover everything. rgb: (H, W, 3) linear light, multiplied by alpha (H, W)."""

    rgb: Float32[np.ndarray, "height width 3"]
    alpha: Float32[np.ndarray, "height width"]


Picture = Float32[np.ndarray, "height width 3"] | Rgba | Layer
"""What is written: a finished picture of linear light, opaque or not, or a virtual layer alone."""


@runtime_checkable
class FrameMaker(Protocol):
    """Maker of one frame of the result from one of the clip. Caches from frame to frame may only save time."""

    def make(
        self,
        index: int,
        rgb: Float32[np.ndarray, "height width 3"],
        time_s: float,
        alpha: Float32[np.ndarray, "height width"] | None = None,
    ) -> Picture:
        """Make one frame. index: within the clip. rgb: (H, W, 3) linear Rec.709, not to be changed. time_s: within the clip.

        alpha: (H, W), the clip's own, by which rgb is multiplied; None is opaque, and so is the result then.
        """
        ...


@runtime_checkable
class MakerRecipe(Protocol):
    """Frozen dataclass of names, numbers and absolute paths, which can be pickled and says all that the result depends on."""

    @property
    def files(self) -> tuple[Path, ...]:
        """Files that are read, patterns of sequences too: when one changes, parts made before do not fit any more."""
        ...

    def build(self, threads: int) -> FrameMaker:
        """Build the maker. threads: number of cores it may use, 0 for all."""
        ...


@dataclass(frozen=True, eq=False)
class Shot:
    """Stretch of a clip to render.

    taken: the frames of the clip, counted from its first, in their order. segment_frames: number of frames of a segment, for any executor.
    All of it can be pickled, and paths are absolute.
    """

    source: PictureSource
    recipe: MakerRecipe
    target: "Target"
    taken: Sequence[int]
    segment_frames: int

    @property
    def segments(self) -> list[Segment]:
        begins = range(0, len(self.taken), self.segment_frames)
        return [Segment(number, self.taken[first : first + self.segment_frames]) for number, first in enumerate(begins)]

    @property
    def begin_s(self) -> float:
        """The moment of the clip that is time 0 of the result: its own beginning, or that of the first frame taken."""
        return float(self.source.times_s[self.taken[0]]) if self.taken[0] else 0.0

    @property
    def parts_path(self) -> Path:
        """Folder in which finished segments wait for the others."""
        return self.target.path.with_name(self.target.parts_name(self.taken))

    @property
    def was_begun(self) -> bool:
        """Whether a run for this result was interrupted."""
        return (self.parts_path / MANIFEST).is_file()

    def times_s(self, segment: Segment) -> list[float]:
        """Return the times of a segment's frames in the result."""
        return [float(self.source.times_s[index]) - self.begin_s for index in segment.taken]

    @property
    def all_times_s(self) -> list[float]:
        """Times of all frames of the shot."""
        return self.times_s(Segment(0, self.taken))


@runtime_checkable
class PartSink(Protocol):
    """Sink for the frames of one segment in their order."""

    def write(self, picture: Picture, index: int, time_s: float) -> None:
        """Write a frame. index: within the clip. time_s: within the result."""
        ...


@runtime_checkable
class Target(Protocol):
    """Destination of frames. A part exists as a file only when all of its frames are written; so an existing part need not be made
    again.
    """

    @property
    def path(self) -> Path:
        """The file, or the pattern of the files."""
        ...

    @property
    def settings(self) -> dict[str, str]:
        """Settings that the parts depend on beside the pictures."""
        ...

    def parts_name(self, taken: Sequence[int]) -> str:
        """The name of the folder of the parts, beside the result. taken: the frames of the shot."""
        ...

    @property
    def lacks_alpha(self) -> str | None:
        """Reason why coverage of finished pictures is left out, and what keeps it; None if it is stored."""
        ...

    def require_new(self, shot: Shot, overwrite: bool) -> None:
        """Raise InputError if the result exists already, or cannot hold such pictures and times."""
        ...

    def part(self, folder: Path, segment: Segment) -> Path:
        """The file that says by being there that the segment is finished."""
        ...

    def writing(self, shot: Shot, segment: Segment, folder: Path) -> AbstractContextManager[PartSink]:
        """Open a block in which the frames of a segment are written."""
        ...

    def join(self, shot: Shot, folder: Path) -> str:
        """Join the parts to the result. Returns what became of the sound, for the user to read."""
        ...
