"""Files of one sequence, by a pattern such as frames.%04d.exr or frames.####.exr, or by the folder that holds nothing else."""

import re
from dataclasses import dataclass
from pathlib import Path

from mrbokeh.system.errors import InputError

_NUMBER = re.compile(r"%(?:0(\d+))?d|(#+)")
_LAST_DIGITS = re.compile(r"\d+(?=\D*$)")


def is_pattern(path: Path | str) -> bool:
    """Whether a name stands for many files."""
    return _NUMBER.search(Path(path).name) is not None


@dataclass(frozen=True)
class NumberedFiles:
    """The files from number `first` on, one for every frame, without a gap."""

    pattern: Path
    first: int
    count: int

    @classmethod
    def found(cls, pattern: Path) -> "NumberedFiles":
        """What there is on the disk. Raises InputError where there is nothing, or a number is missing."""
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
            raise InputError(f"expected files named {pattern}, but there is none")
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
            raise InputError(f"frame {index} needs {numbered(self.pattern, self.first + index)}, but the sequence ends with {last}")
        return numbered(self.pattern, self.first + index)

    @property
    def files(self) -> list[Path]:
        return [self.file(index) for index in range(self.count)]


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
