"""All checks over a shot, one picture at a time, each beside its picture of the plate: by number, by time in films, else by order."""

import sys
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import zip_longest
from pathlib import Path

from mrbokeh.checks.checked_picture import SHARP, VIRTUAL, CheckedPicture, Shot, with_layers
from mrbokeh.checks.picture_checks import CheckReport, Finding, FlickerScore, LeakMap, check_energy, check_numbers, reach
from mrbokeh.images.image_io import read_layer
from mrbokeh.images.layer import Layer
from mrbokeh.optics.lens import Lens
from mrbokeh.system.console import track
from mrbokeh.system.errors import InputError
from mrbokeh.video.image_sequence import is_pattern, numbered

Pair = tuple[CheckedPicture | str, CheckedPicture | None]

_SAME_TIME_S = 2e-3


@dataclass(frozen=True)
class Taken:
    """Numbers of the plate's frames from which a shot was made, None all; first_number: of the first frame of a film."""

    numbers: Sequence[int] | None = None
    first_number: int = 0

    def number_of(self, index: int, shot: Shot) -> int:
        """Return the number of a picture of a shot; those of a film are the plate's."""
        if shot.numbers is not None:
            return shot.numbers[index]
        return self.first_number + index if self.numbers is None or index >= len(self.numbers) else self.numbers[index]

    def of(self, plate: Shot) -> Iterator[tuple[int, CheckedPicture]]:
        """Yield the pictures taken, each with its place in the plate; nothing behind the last is read."""
        wanted = None if self.numbers is None else set(self.numbers)
        named = range(self.first_number, sys.maxsize) if plate.numbers is None else plate.numbers
        for place, (number, picture) in enumerate(zip(named, plate.pictures(), strict=False)):
            if wanted is None or number in wanted:
                yield place, _readable(picture, plate)
            if self.numbers is not None and number >= self.numbers[-1]:
                return


def pairs(report: CheckReport, shot: Shot, plate: Shot | None, taken: Taken) -> Iterator[Pair]:
    """Yield checked pictures with their plates, None if there is none. What the plate has and the shot lacks becomes a finding.

    Raises InputError if a picture of the plate cannot be read or is of another size.
    """
    _note_missing(report, shot.path.name, [str(number) for number in sorted(_missing_numbers(shot, plate, taken))])
    if plate is None:
        paired: Iterator[Pair] = ((picture, None) for picture in shot.pictures())
    elif not plate.is_sequence and len(plate.numbers or ()) == 1:
        still = _readable(next(plate.pictures()), plate)
        paired = ((picture, still) for picture in shot.pictures())
    elif shot.numbers is not None and plate.numbers is not None:
        paired = _by_number(shot, plate)
    elif shot.numbers is None and plate.numbers is None:
        paired = _by_time(report, shot, plate, taken)
    else:
        paired = _by_order(report, shot, plate, taken)
    for picture, other in paired:
        _require_same_size(picture, other)
        yield picture, other


def _missing_numbers(shot: Shot, plate: Shot | None, taken: Taken) -> set[int]:
    missing = set(shot.missing) if taken.numbers is None else set(shot.missing) & set(taken.numbers)
    if plate is not None and plate.is_sequence == shot.is_sequence and shot.numbers is not None and len(plate.numbers or ()) > 1:
        there = set(plate.numbers or ())
        missing |= (there if taken.numbers is None else there & set(taken.numbers)) - set(shot.numbers)
    return missing


def _by_number(shot: Shot, plate: Shot) -> Iterator[Pair]:
    """Pair by number; both are sorted, and pictures that only the plate has are skipped."""
    plates = zip(plate.numbers or (), plate.pictures(), strict=True)
    number, other = next(plates)
    for wanted, picture in zip(shot.numbers or (), shot.pictures(), strict=True):
        while number < wanted and (after := next(plates, None)) is not None:
            number, other = after
        yield picture, _readable(other, plate) if number == wanted else None


def _by_time(report: CheckReport, shot: Shot, plate: Shot, taken: Taken) -> Iterator[Pair]:
    """Pair by time: times of the shot count from the first frame taken of the plate, unless that is the plate's first."""
    plates = taken.of(plate)
    place, other = next(plates, (0, None))
    if other is None or other.time_s is None:
        raise InputError(f"the plate {plate.path} has none of the --frames: give the numbers of its frames from which {shot.path} was made")
    start_s, passed = other.time_s if place else 0.0, list[str]()
    ended = False
    for picture in shot.pictures():
        time_s = start_s + (0.0 if isinstance(picture, str) or picture.time_s is None else picture.time_s)
        while not ended and (other.time_s or 0.0) < time_s - _SAME_TIME_S:
            passed.append(other.name)
            after = next(plates, None)
            other, ended = (other, True) if after is None else (after[1], False)
        if ended or (other.time_s or 0.0) > time_s + _SAME_TIME_S:
            yield picture, None
            continue
        yield picture, other
        after = next(plates, None)
        other, ended = (other, True) if after is None else (after[1], False)
    rest = [] if ended else [other.name, *(each.name for _, each in plates)]
    _note_missing(report, shot.path.name, [f"the plate's {each}" for each in (*passed, *rest)])


def _by_order(report: CheckReport, shot: Shot, plate: Shot, taken: Taken) -> Iterator[Pair]:
    lacking = []
    for picture, other in zip_longest(shot.pictures(), (each for _, each in taken.of(plate))):
        if picture is not None:
            yield picture, other
        elif other is not None:
            lacking.append(f"the plate's {other.name}")
    _note_missing(report, shot.path.name, lacking)


def _note_missing(report: CheckReport, where: str, names: list[str]) -> None:
    if names:
        text = f"{len(names)} pictures are missing: {', '.join(names[:12])}{' ...' if len(names) > 12 else ''}"
        report.findings.append(Finding(check="missing", where=where, text=text, value=float(len(names)), limit=0.0))


def _readable(picture: CheckedPicture | str, plate: Shot) -> CheckedPicture:
    if isinstance(picture, str):
        raise InputError(f"a picture of the plate {plate.path} cannot be read: {picture}")
    return picture


def _require_same_size(picture: CheckedPicture | str, plate: CheckedPicture | None) -> None:
    if not isinstance(picture, str) and plate is not None and picture.rgb.shape != plate.rgb.shape:
        (height, width), (rows, columns) = picture.rgb.shape[:2], plate.rgb.shape[:2]
        raise InputError(f"{picture.name} is {width}x{height} px, its plate {columns}x{rows} px: give the plate that it was made from")


@dataclass(frozen=True)
class CheckSettings:
    """Settings of all checks.

    layers: files of layers by name (virtual, sharp), one for all pictures, or a folder or pattern with one for each.
    lens: as focused for the shot, to find the reach of a sharp layer. energy_tolerance: share of the light. flicker_limit: mean
    absolute difference beyond the plate's own. tolerance: how far a pixel may differ from the plate (sRGB code; in EXR share of the
    light); None: what storing it explains. taken: frames of the plate, from which the shot was made.
    """

    layers: Mapping[str, Path] = field(default_factory=dict)
    lens: Lens | None = None
    energy_tolerance: float = 0.01
    flicker_limit: float = 0.002
    tolerance: float | None = None
    taken: Taken = field(default_factory=Taken)


def check_shot(shot: Shot, plate: Shot | None, settings: CheckSettings) -> tuple[CheckReport, LeakMap]:
    """Check a shot. Raises InputError if no picture can be read, or the plate is of another size."""
    report, leaks, flicker = CheckReport(), LeakMap(settings.tolerance), FlickerScore()
    passed = track(pairs(report, shot, plate, settings.taken), f"checking {shot.path.name}", len(shot.numbers or ()))
    still = {name: read_layer(path) for name, path in settings.layers.items() if not _is_many(path)}
    for index, (picture, other) in enumerate(passed):
        if isinstance(picture, str):
            report.findings.append(Finding(check="damaged", where=shot.path.name, text=picture, value=1.0, limit=0.0))
            flicker.skip()
            continue
        report.pictures += 1
        complete = with_layers(picture, still | _layers(settings.layers, index, settings.taken.number_of(index, shot)))
        _check_one(report, complete, other, settings, leaks)
        if other is not None and shot.is_sequence:
            flicker.add(report, picture.name, picture.rgb, other.rgb)
    if not report.pictures:
        raise InputError(f"no picture of {shot.path} can be read: {report.findings[-1].text if report.findings else 'it is empty'}")
    flicker.judge(report, settings.flicker_limit)
    return report, leaks


def _check_one(report: CheckReport, picture: CheckedPicture, plate: CheckedPicture | None, settings: CheckSettings, leaks: LeakMap) -> None:
    check_numbers(report, picture, None if plate is None else plate.rgb)
    check_energy(report, picture, settings.energy_tolerance)
    if not {VIRTUAL, SHARP} <= picture.layers.keys():
        report.skipped["energy"] = "needs the virtual layer before and after the blur: give --sharp and --virtual, or a layered EXR"
    if plate is None:
        report.skipped |= dict.fromkeys(("leak", "flicker"), "needs the photograph or clip: give --against")
        return
    reached = reach(picture, settings.lens)
    if reached is None:
        report.skipped["leak"] = "needs to know where virtual light arrives: give --virtual, or --sharp with --lens, or a layered EXR"
    else:
        leaks.add(report, picture, plate.rgb, reached)


def _is_many(path: Path) -> bool:
    return path.is_dir() or (is_pattern(path) and not path.exists())


def _layers(files: Mapping[str, Path], index: int, number: int) -> dict[str, Layer]:
    """Read the layers that have one file for each picture."""
    return {name: read_layer(_of_picture(path, index, number)) for name, path in files.items() if _is_many(path)}


def _of_picture(folder: Path, index: int, number: int) -> Path:
    if not folder.is_dir():
        return numbered(folder, number)
    files = sorted(each for each in folder.glob("*.exr") if not each.name.startswith("."))
    if index >= len(files):
        raise InputError(f"{folder} holds {len(files)} layers (.exr), too few for the pictures: expected one for each")
    return files[index]
