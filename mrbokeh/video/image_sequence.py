"""ImageSequence: numbered pictures as the frames of a shot; EXR and HDR are linear, integers of PNG and TIFF are sRGB.

Files are named by a pattern such as frames.%04d.exr or frames.####.exr, or by the folder that holds nothing else. Photographs are
brought upright as EXIF says. Alpha is read if the first picture holds some; others without it are opaque.
"""

import re
from bisect import bisect_right
from collections.abc import Collection, Iterable, Iterator, Sequence
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path

import numpy as np
from jaxtyping import Float32, Float64

from mrbokeh.images.alpha_io import is_straight, read_alpha, stores_alpha, straight
from mrbokeh.images.color_management import NamedSpace
from mrbokeh.images.exif import AS_STORED, quarter_turns, stored_orientation, upright
from mrbokeh.images.exr_io import header_of, read_exr
from mrbokeh.images.image_io import LINEAR_SUFFIXES, read_image
from mrbokeh.system.errors import InputError
from mrbokeh.video.clip import Frame, VideoInfo
from mrbokeh.video.color import FULL, VideoColor
from mrbokeh.video.timecode import Timecode

_NUMBER = re.compile(r"%(?:0(\d+))?d|(#+)")
_LAST_DIGITS = re.compile(r"\d+(?=\D*$)")

_LINEAR, _SRGB = 8, 13
_NAMED = 60
_SAME_RATE = Fraction(1, 5000)


def is_pattern(path: Path | str) -> bool:
    """Return whether a name stands for many files."""
    return _NUMBER.search(Path(path).name) is not None


@dataclass(frozen=True)
class NumberedFiles:
    """The files from number `first` on, one for every frame but those whose numbers are missing."""

    pattern: Path
    first: int
    count: int
    missing: frozenset[int] = frozenset()

    @classmethod
    def found(cls, pattern: Path) -> "NumberedFiles":
        """Find the files of a pattern. Raises InputError if there is none."""
        numbers = numbers_of(pattern)
        whole = range(numbers[0], numbers[-1] + 1)
        return cls(pattern, whole[0], len(whole), frozenset(whole) - frozenset(numbers))

    def file(self, index: int) -> Path:
        """The file of a frame, counted from the first. Raises InputError beyond the end."""
        if not 0 <= index < self.count:
            last = numbered(self.pattern, self.first + self.count - 1)
            wanted = numbered(self.pattern, self.first + index)
            raise InputError(f"frame {index} needs {wanted}, but the sequence ends with {last}: take fewer frames")
        return numbered(self.pattern, self.first + index)

    @property
    def files(self) -> list[Path]:
        """Files that are there."""
        return [self.file(index) for index in range(self.count) if self.first + index not in self.missing]


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


STOP, HOLD, BLACK = "stop", "hold", "black"
"""What becomes of frames whose files are missing: nothing is made, the frame before stands for them, or nothing is seen."""


def require_missing_known(missing: str) -> None:
    if missing not in (STOP, HOLD, BLACK):
        raise InputError(f"--missing: expected {STOP}, {HOLD} or {BLACK}, got {missing!r}")


def require_all_there(where: Path, there: Collection[int], wanted: Sequence[int]) -> None:
    """Raise InputError if numbers of files are missing among those wanted, which it names."""
    lacking = sorted(set(wanted) - set(there))
    if len(lacking) == len(wanted) > 1:
        has, taken = written_frames(sorted(there)), written_frames(lacking)
        raise InputError(f"{where} has the frames {has}, none of those taken ({taken}): say --first-number, or take others by --frames")
    if lacking:
        told = written_frames(lacking[:_NAMED]) + (", ..." if len(lacking) > _NAMED else "")
        raise InputError(
            f"{where}: {len(lacking)} of the {len(wanted)} frames are missing ({told}): render them, or say --missing hold, which shows "
            f"the frame before, or --missing black, which shows nothing"
        )


def held_number(there: Iterable[int], wanted: int) -> int:
    """Return the number of the file that stands for a missing one: the last before, or the first of all."""
    numbers = sorted(there)
    return numbers[max(0, bisect_right(numbers, wanted) - 1)]


def written_frames(numbers: Sequence[int]) -> str:
    """Return frame numbers as --frames takes them."""
    begins = [each for place, each in enumerate(numbers) if place == 0 or each - numbers[place - 1] > 1]
    ends = [each for place, each in enumerate(numbers) if place + 1 == len(numbers) or numbers[place + 1] - each > 1]
    return ",".join(str(begin) if begin == end else f"{begin}-{end}" for begin, end in zip(begins, ends, strict=True))


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


def stated_rate(path: Path) -> Fraction | None:
    """Return the frames per second that the header of an EXR states."""
    stated = header_of(path).get("framesPerSecond") if path.suffix.lower() == ".exr" else None
    return None if stated is None else Fraction(stated)


def require_rate(path: Path, rate: Fraction, of: str) -> None:
    """Raise InputError if an EXR states another rate than it is to be shown with. of: where that comes from."""
    stated = stated_rate(path)
    if stated is not None and abs(rate / stated - 1) > _SAME_RATE:
        raise InputError(
            f"{path} states {float(stated):.5g} frames per second, but {of} says {float(rate):.5g}: nothing is retimed here; retime it "
            f"before, or correct its header (framesPerSecond)"
        )


def _rate(path: Path, told: Fraction | None) -> Fraction:
    """Return the rate of a sequence by what is told and what its first file states."""
    rate = stated_rate(path) if told is None else told
    if rate is None:
        raise InputError(f"{path}: numbered pictures have no rate of their own: give --rate, such as 25 or 24000/1001")
    require_rate(path, rate, "--rate")
    return rate


def read_numbers(path: Path) -> Float32[np.ndarray, "height width 3"]:
    """Read a picture's stored numbers, for a named colour space: integers as 0 to 1 without a curve; EXR without its stated primaries."""
    return read_exr(path)[0].stacked("RGB") if path.suffix.lower() == ".exr" else read_image(path, "linear")


@dataclass(frozen=True, eq=False)
class ImageSequence:
    """A PictureSource; frame 0 is the file with the smallest number and is shown at time 0. orientation: EXIF's, of every file.

    missing: what becomes of frames without a file: stop, hold or black.
    """

    numbered: NumberedFiles
    info: VideoInfo
    space: NamedSpace | None = None
    orientation: int = AS_STORED
    missing: str = STOP

    @classmethod
    def open(cls, pattern: Path, frame_rate: Fraction | None, space: NamedSpace | None = None, missing: str = STOP) -> "ImageSequence":
        """Open the files of a pattern. frame_rate: None takes that of an EXR header; InputError without it, or where it is another."""
        numbered = NumberedFiles.found(pattern)
        frame_rate = _rate(numbered.file(0), frame_rate)
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
        return cls(numbered, info, space, orientation, missing)

    @property
    def path(self) -> Path:
        return self.numbered.pattern

    @property
    def times_s(self) -> Float64[np.ndarray, " frames"]:
        return np.array([float(index / self.info.frame_rate) for index in range(self.numbered.count)])

    @property
    def first_number(self) -> int:
        return self.numbered.first

    @property
    def there(self) -> Collection[int]:
        return [
            number for number in range(self.first_number, self.first_number + self.numbered.count) if number not in self.numbered.missing
        ]

    def file_of(self, index: int) -> Path | None:
        """The file that shows a frame; None of a missing one that is black."""
        number = self.first_number + index
        if number not in self.numbered.missing:
            return self.numbered.file(index)
        if self.missing == STOP:
            require_all_there(self.path, self.there, [number])
        return numbered(self.path, held_number(self.there, number)) if self.missing == HOLD else None

    def timecode_of(self, index: int) -> Timecode | None:
        path = self.file_of(index)
        code = None if path is None or path.suffix.lower() != ".exr" else header_of(path).get("timeCode")
        return None if code is None else Timecode.of_exr(code, self.info.frame_rate)

    def frames(self, start: int, stop: int, threads: int = 0) -> Iterator[Frame]:  # noqa: ARG002
        for index in range(start, stop):
            path, time_s = self.file_of(index), float(index / self.info.frame_rate)
            if path is None:
                nothing = np.zeros((self.info.height_px, self.info.width_px), np.float32)
                yield Frame(np.dstack([nothing] * 3), time_s, nothing if self.info.has_alpha else None)
                continue
            self._require_same_way(path)
            yield self._frame(path, time_s)

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
