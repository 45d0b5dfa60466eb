"""SequenceTarget: numbered pictures; EXR linear in half, PNG and TIFF in 16-bit sRGB."""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from mrbokeh.atomic_files import write_json
from mrbokeh.errors import InputError
from mrbokeh.image_io import INTEGER_SUFFIXES, write_image, write_layer
from mrbokeh.layer import Layer
from mrbokeh.picture_sources.numbered_files import numbered
from mrbokeh.shots.frame_maker import Picture
from mrbokeh.shots.segment import Segment
from mrbokeh.shots.shot import PartSink, Shot

_EXR = ".exr"


@dataclass(frozen=True)
class SequenceTarget:
    """A Target. first_number: of the clip's frame 0, whether it is taken or not. layers: what is written is layers."""

    path: Path
    first_number: int = 0
    layers: bool = False

    @property
    def settings(self) -> dict[str, str]:
        return {"container": self.path.name, "numbers": f"{self.first_number} layers={self.layers}"}

    def require_new(self, shot: Shot, overwrite: bool) -> None:
        suffix = self.path.suffix.lower()
        if suffix != _EXR and (self.layers or suffix not in INTEGER_SUFFIXES):
            expected = _EXR if self.layers else f"{_EXR}, {', '.join(INTEGER_SUFFIXES)}"
            raise InputError(f"cannot write {self.path}: expected numbered {expected}, not {suffix or 'files without suffix'}")
        files = (self.file(index) for index in range(shot.start, shot.stop))
        there = next((file for file in files if file.exists()), None)
        if there is not None and not overwrite:
            raise InputError(f"{there} exists already: give another name, or --overwrite to replace it")

    def part(self, folder: Path, segment: Segment) -> Path:
        return folder / f"{segment.number:05d}.json"

    @contextmanager
    def writing(self, shot: Shot, segment: Segment, folder: Path) -> Iterator[PartSink]:  # noqa: ARG002
        yield _Sink(self)
        write_json(self.part(folder, segment), {"frames": [segment.start, segment.stop]})

    def join(self, shot: Shot, folder: Path) -> str:  # noqa: ARG002
        return "no audio"

    def file(self, index: int) -> Path:
        """Of a frame of the clip."""
        return numbered(self.path, self.first_number + index)


@dataclass(frozen=True)
class _Sink:
    target: SequenceTarget

    def write(self, picture: Picture, index: int, time_s: float) -> None:  # noqa: ARG002
        path = self.target.file(index)
        if isinstance(picture, Layer):
            write_layer(path, picture)
        else:
            write_image(path, picture)
