"""Shot: a stretch of a clip, what makes its frames and where they go; cut into segments that can be made one without the other."""

from contextlib import AbstractContextManager
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol, runtime_checkable

from mrbokeh.shots.frame_maker import MakerRecipe, Picture
from mrbokeh.shots.segment import Segment, segments_between
from mrbokeh.video.picture_sources.base import PictureSource

MANIFEST = "manifest.json"
"""In the folder of the parts: what they were made with."""


@dataclass(frozen=True, eq=False)
class Shot:
    """start, stop: the frames of the clip that are taken. segment_frames: how many make a segment, whoever makes it.

    Everything in it can be pickled, and paths are absolute.
    """

    source: PictureSource
    recipe: MakerRecipe
    target: "Target"
    start: int
    stop: int
    segment_frames: int

    @property
    def segments(self) -> list[Segment]:
        return segments_between(self.start, self.stop, self.segment_frames)

    @property
    def begin_s(self) -> float:
        """The moment of the clip that is time 0 of the result: its own beginning, or that of the first frame taken."""
        return float(self.source.times_s[self.start]) if self.start else 0.0

    @property
    def parts_path(self) -> Path:
        """Where finished segments wait for the others."""
        return self.target.path.with_name(self.target.path.name + ".parts")

    @property
    def was_begun(self) -> bool:
        """Whether a run for this result was interrupted."""
        return (self.parts_path / MANIFEST).is_file()

    def times_s(self, segment: Segment) -> list[float]:
        """When the frames of a segment are shown in the result."""
        return [float(time_s) - self.begin_s for time_s in self.source.times_s[segment.start : segment.stop]]

    @property
    def all_times_s(self) -> list[float]:
        """Of all frames of the shot."""
        return self.times_s(Segment(0, self.start, self.stop))


@runtime_checkable
class PartSink(Protocol):
    """Takes the frames of one segment in their order."""

    def write(self, picture: Picture, index: int, time_s: float) -> None:
        """index: within the clip. time_s: within the result."""
        ...


@runtime_checkable
class Target(Protocol):
    """Where frames go. A part exists as a file only when all of its frames are written; so what exists need not be made again."""

    @property
    def path(self) -> Path:
        """The file, or the pattern of the files."""
        ...

    @property
    def settings(self) -> dict[str, str]:
        """What the parts depend on beside the pictures."""
        ...

    @property
    def lacks_alpha(self) -> str | None:
        """Why coverage of finished pictures is left out, and what keeps it; None where it is stored."""
        ...

    def require_new(self, shot: Shot, overwrite: bool) -> None:
        """Raises InputError where the result exists already, or cannot hold such pictures and times."""
        ...

    def part(self, folder: Path, segment: Segment) -> Path:
        """The file that says by being there that the segment is finished."""
        ...

    def writing(self, shot: Shot, segment: Segment, folder: Path) -> AbstractContextManager[PartSink]:
        """A block in which the frames of a segment are written."""
        ...

    def join(self, shot: Shot, folder: Path) -> str:
        """Make the result out of its parts. Returns what became of the sound, for the user to read."""
        ...
