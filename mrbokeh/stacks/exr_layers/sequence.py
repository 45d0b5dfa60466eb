"""Numbered EXR files of a render: which frames there are, and their layers."""

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from mrbokeh.images.layer import Layer
from mrbokeh.stacks.exr_layers.deep_layers import DeepSamples, DeepSurfaces, is_deep
from mrbokeh.stacks.exr_layers.render_channels import FlatRender, LayerReader
from mrbokeh.system.errors import InputError

_PLACE = re.compile(r"%0?(\d*)d|(#+)|\$F(\d*)")
# A hyphen is a minus after . or _ only: shot-0001.exr is frame 1.
_NUMBER = re.compile(r"^(.*?)((?:(?<=[._])-)?\d+)(\.exr)$", re.IGNORECASE)
_NAMED_GAPS = 12


@dataclass(frozen=True)
class ExrSequence:
    """Files by frame number, read when a frame is asked for; a still stands for every frame.

    paths: of all frames. frames: the numbers from the first to the last.
    """

    paths: Mapping[int, Path]
    frames: range
    reader: LayerReader
    is_still: bool = False

    @classmethod
    def of(cls, where: Path | str, reader: LayerReader | None = None, *, whole: bool = True) -> "ExrSequence":
        """Find the files of a sequence. Raises InputError if nothing is found, or one that is to be whole has gaps.

        where: beauty.%04d.exr, beauty.####.exr, beauty.$F4.exr, a folder with one sequence, or a single file.
        reader: how files are understood; None takes FlatRender, or DeepSurfaces if they are deep.
        """
        found, is_still = _found(Path(where))
        frames = range(min(found), max(found) + 1)
        if whole:
            _require_all(where, found, frames)
        return cls(found, frames, reader or _reader_for(next(iter(found.values()))), is_still)

    def path_of(self, frame: int) -> Path:
        """Return the file that shows a frame."""
        if self.is_still:
            return next(iter(self.paths.values()))
        if frame not in self.paths:
            raise InputError(
                f"the render has frames {self.frames[0]} to {self.frames[-1]}, not {frame}: render that one, or take its range"
            )
        return self.paths[frame]

    def layers(self, frame: int) -> list[Layer]:
        """Return sharp layers of a frame, front first."""
        return self.reader.layers(self.path_of(frame))

    @property
    def is_deep(self) -> bool:
        """Return whether its samples can be put among other layers by depth."""
        return isinstance(self.reader, DeepSurfaces)

    def samples(self, frame: int) -> DeepSamples:
        """Return the samples of a deep frame. Raises InputError if the files are flat."""
        if not isinstance(self.reader, DeepSurfaces):
            raise InputError(f"expected deep pictures, but {self.path_of(frame)} is read as flat: take its layers")
        return DeepSamples.read(self.path_of(frame))


def _reader_for(path: Path) -> LayerReader:
    return DeepSurfaces() if is_deep(path) else FlatRender()


def _found(where: Path) -> tuple[dict[int, Path], bool]:
    """Return files by number, and whether it is one file without a sequence."""
    if where.is_dir():
        return _in_folder(where), False
    if _PLACE.search(where.name):
        return _matching(where), False
    if not where.is_file():
        raise InputError(f"expected an EXR file, a folder or a pattern like beauty.####.exr at {where}, but there is no such file")
    numbered = _NUMBER.match(where.name)
    return {int(numbered[2]) if numbered else 0: where}, True


def _matching(pattern: Path) -> dict[int, Path]:
    """Return the files of a pattern. Digits may be more than asked for, as in counting beyond 9999, but not fewer."""
    place = _PLACE.search(pattern.name)
    assert place is not None
    digits = len(place[2]) if place[2] else int(place[1] or place[3] or 1)
    begin, end = re.escape(pattern.name[: place.start()]), re.escape(pattern.name[place.end() :])
    name = re.compile(f"{begin}(-?\\d{{{digits},}}){end}")
    found = {int(match[1]): path for path in _files(pattern.parent) if (match := name.fullmatch(path.name))}
    if not found:
        raise InputError(f"expected files like {pattern}, but there is none in {pattern.parent}")
    return found


def _in_folder(folder: Path) -> dict[int, Path]:
    """Return the one sequence of a folder."""
    sequences: dict[tuple[str, str], dict[int, Path]] = {}
    for path in _files(folder):
        if match := _NUMBER.match(path.name):
            sequences.setdefault((match[1], match[3]), {})[int(match[2])] = path
    if len(sequences) != 1:
        names = ", ".join(f"{begin}####{end}" for begin, end in sorted(sequences)) or "none"
        raise InputError(f"{folder}: expected one sequence of numbered EXR files, found {names}: give a pattern like beauty.####.exr")
    return next(iter(sequences.values()))


def _files(folder: Path) -> Sequence[Path]:
    return sorted(path for path in folder.iterdir() if not path.name.startswith(".")) if folder.is_dir() else []


def _require_all(where: Path | str, found: Mapping[int, Path], frames: range) -> None:
    missing = [number for number in frames if number not in found]
    if missing:
        named = ", ".join(str(number) for number in missing[:_NAMED_GAPS]) + (" and more" if len(missing) > _NAMED_GAPS else "")
        raise InputError(f"{where}: {len(missing)} of the frames {frames[0]} to {frames[-1]} are missing ({named}): render them")
