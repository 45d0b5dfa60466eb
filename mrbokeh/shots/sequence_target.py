"""SequenceTarget: numbered pictures; EXR linear in half, PNG and TIFF in 16-bit sRGB."""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from mrbokeh.atomic_files import write_json
from mrbokeh.color_management import NamedSpace
from mrbokeh.errors import InputError
from mrbokeh.image_io import INTEGER_SUFFIXES, write_image, write_layer
from mrbokeh.layer import Layer
from mrbokeh.picture_sources.numbered_files import numbered
from mrbokeh.shots.frame_maker import Picture
from mrbokeh.shots.result_space import in_space
from mrbokeh.shots.segment import Segment
from mrbokeh.shots.shot import PartSink, Shot

_EXR = ".exr"


@dataclass(frozen=True)
class SequenceTarget:
    """A Target. first_number: of the clip's frame 0, whether it is taken or not. layers: what is written is layers.

    space: what the numbers of the pictures are; None is linear Rec.709 in EXR and sRGB in integers.
    """

    path: Path
    first_number: int = 0
    layers: bool = False
    space: NamedSpace | None = None

    @property
    def settings(self) -> dict[str, str]:
        numbers = f"{self.first_number} layers={self.layers}"
        return {"container": self.path.name, "numbers": numbers, "output space": str(self.space or "")}

    def require_new(self, shot: Shot, overwrite: bool) -> None:
        suffix = self.path.suffix.lower()
        if suffix != _EXR and (self.layers or suffix not in INTEGER_SUFFIXES):
            expected = _EXR if self.layers else f"{_EXR}, {', '.join(INTEGER_SUFFIXES)}"
            raise InputError(f"cannot write {self.path}: expected numbered {expected}, not {suffix or 'files without suffix'}")
        if suffix != _EXR and self.space is not None and self.space.is_linear:
            raise InputError(
                f"{self.path}: {self.space.name} is linear light, which integers cut off at 1: write .exr, or name a space with a curve"
            )
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
        path, space = self.target.file(index), self.target.space
        stored = in_space(picture, space)
        if isinstance(stored, Layer):
            write_layer(path, stored)
        else:
            write_image(path, stored, "srgb" if space is None else "linear")
