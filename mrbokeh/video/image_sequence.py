"""ImageSequence: numbered pictures as the frames of a shot; EXR and HDR are linear, integers of PNG and TIFF are sRGB.

Files are named by a pattern such as frames.%04d.exr or frames.####.exr, or by the folder that holds nothing else. Photographs are
brought upright as EXIF says. Alpha is read if the first picture holds some; others without it are opaque.
"""

import re
from collections.abc import Iterator
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path

import numpy as np
from jaxtyping import Float32, Float64

from mrbokeh.images.alpha_io import is_straight, read_alpha, stores_alpha, straight
from mrbokeh.images.color_management import NamedSpace
from mrbokeh.images.exif import AS_STORED, quarter_turns, stored_orientation, upright
from mrbokeh.images.exr_io import read_exr
from mrbokeh.images.image_io import LINEAR_SUFFIXES, read_image
from mrbokeh.system.errors import InputError
from mrbokeh.video.clip import Frame, VideoInfo
from mrbokeh.video.color import FULL, VideoColor

_NUMBER = re.compile(r"%(?:0(\d+))?d|(#+)")
_LAST_DIGITS = re.compile(r"\d+(?=\D*$)")

_LINEAR, _SRGB = 8, 13


def is_pattern(path: Path | str) -> bool:
    """Return whether a name stands for many files."""
    return _NUMBER.search(Path(path).name) is not None


@dataclass(frozen=True)
class NumberedFiles:
    """The files from number `first` on, one for every frame, without a gap."""

    pattern: Path
    first: int
    count: int

    @classmethod
    def found(cls, pattern: Path) -> "NumberedFiles":
        """Find the files of a pattern. Raises InputError if there is none, or a number is missing."""
        numbers = numbers_of(pattern)
        files = cls(pattern, numbers[0], numbers[-1] - numbers[0] + 1)
        missing = sorted(set(range(numbers[0], numbers[-1] + 1)) - set(numbers))
        if missing:
            raise InputError(
                f"{numbered(pattern, missing[0])} is missing ({len(missing)} of {files.count} are): render it, or rename the rest"
            )
        return files

    def file(self, index: int) -> Path:
        """The file of a frame, counted from the first. Raises InputError beyond the end."""
        if not 0 <= index < self.count:
            last = numbered(self.pattern, self.first + self.count - 1)
            wanted = numbered(self.pattern, self.first + index)
            raise InputError(f"frame {index} needs {wanted}, but the sequence ends with {last}: take fewer frames")
        return numbered(self.pattern, self.first + index)

    @property
    def files(self) -> list[Path]:
        return [self.file(index) for index in range(self.count)]


def numbers_of(pattern: Path) -> list[int]:
    """Return the numbers of the files of a pattern, in order. Raises InputError if there is none."""
    place = _NUMBER.search(pattern.name)
    if place is None:
        raise InputError(f"expected a pattern such as frames.%04d.exr, got {pattern}")
    before, after = re.escape(pattern.name[: place.start()]), re.escape(pattern.name[place.end() :])
    digits = rf"\d{{{_width(place)},}}"
    named = re.compile(f"{before}({digits}){after}")
    folder = pattern.parent
    matches = (named.fullmatch(file.name) for file in folder.iterdir()) if folder.is_dir() else ()
    numbers = sorted({int(match.group(1)) for match in matches if match})
    if not numbers:
        raise InputError(f"expected files named {pattern}, but there is none: check the folder and the number of digits")
    return numbers


def numbered(pattern: Path, number: int) -> Path:
    """The name of one file of a pattern."""
    place = _NUMBER.search(pattern.name)
    if place is None:
        return pattern
    return pattern.with_name(f"{pattern.name[: place.start()]}{number:0{_width(place)}d}{pattern.name[place.end() :]}")


def pattern_of_folder(folder: Path) -> Path:
    """The pattern of the only sequence in a folder. Raises InputError where there is none, or several."""
    files = sorted(file for file in folder.iterdir() if file.is_file() and not file.name.startswith(".") and _LAST_DIGITS.search(file.stem))
    widths = {len(_LAST_DIGITS.findall(file.stem)[-1]) for file in files}
    width = min(widths, default=0)
    names = {f"{_LAST_DIGITS.sub(f'%0{width}d', file.stem)}{file.suffix}" for file in files}
    if len(names) != 1:
        told = f"holds {len(names)} sequences ({', '.join(sorted(names)[:3])})" if names else "holds no numbered pictures"
        raise InputError(f"{folder} {told}: name one, such as {folder / 'frames.%04d.exr'}")
    return folder / names.pop()


def _width(place: "re.Match[str]") -> int:
    return len(place.group(2)) if place.group(2) else int(place.group(1) or 1)


def read_numbers(path: Path) -> Float32[np.ndarray, "height width 3"]:
    """Read a picture's stored numbers, for a named colour space: integers as 0 to 1 without a curve; EXR without its stated primaries."""
    return read_exr(path)[0].stacked("RGB") if path.suffix.lower() == ".exr" else read_image(path, "linear")


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
        info = VideoInfo(
            width_px=width,
            height_px=height,
            frame_rate=frame_rate,
            time_base=time_base,
            frame_count=numbered.count,
            color=color,
            rotation_deg=turned_deg,
            has_alpha=stores_alpha(first),
        )
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
        """Read a frame. Curves of a space are for straight colour: premultiplied pictures are divided by alpha before them."""
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
        """Return the alpha, 1 for an opaque picture among others, so that results are alike."""
        if not self.info.has_alpha:
            return None
        stored = read_alpha(path)
        if stored is None:
            return np.ones((self.info.height_px, self.info.width_px), np.float32)
        return upright(stored, self.orientation)

    def _require_same_way(self, path: Path) -> None:
        """Raise InputError if a picture is turned otherwise than the first: the lens is turned once, for all frames."""
        orientation = stored_orientation(path)
        if orientation != self.orientation:
            told = f"EXIF says orientation {orientation} of {path}, but {self.orientation} of {self.numbered.file(0)}"
            raise InputError(f"{told}: expected one way up throughout; turn the pictures themselves, or set the tag alike in all")
