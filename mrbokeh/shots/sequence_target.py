"""SequenceTarget: numbered pictures; EXR linear in half, PNG and TIFF in 16-bit sRGB."""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path

from mrbokeh.images.alpha_io import HOLDING_ALPHA, exr_part, in_named_space, write_finished
from mrbokeh.images.color_management import NamedSpace
from mrbokeh.images.exr_io import write_exr
from mrbokeh.images.image_io import INTEGER_SUFFIXES, write_layer
from mrbokeh.images.layer import Layer
from mrbokeh.shots.frame_maker import Picture, Rgba
from mrbokeh.shots.segment import Segment
from mrbokeh.shots.shot import PartSink, Shot
from mrbokeh.system.atomic_files import write_json
from mrbokeh.system.errors import InputError
from mrbokeh.video.picture_sources.numbered_files import numbered

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

    @property
    def lacks_alpha(self) -> str | None:
        suffix = self.path.suffix.lower()
        return None if suffix in HOLDING_ALPHA else f"{suffix} cannot hold it (write .exr, .png or .tif)"

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
        if isinstance(picture, Rgba):
            write_finished(path, picture.rgb, picture.alpha, space)
        elif not isinstance(picture, Layer):
            write_finished(path, picture, None, space)
        elif space is None:
            write_layer(path, picture)
        else:
            part = exr_part(in_named_space(picture.rgb, picture.alpha, space), picture.alpha, space)
            write_exr(path, replace(part, channels={**part.channels, "Z": picture.depth_m}))
