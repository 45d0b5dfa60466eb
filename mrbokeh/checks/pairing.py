"""Which picture of the plate belongs to which checked one: by number, by time in films, else by order."""

from collections.abc import Iterator
from itertools import islice, zip_longest

from mrbokeh.checks.checked_picture import CheckedPicture
from mrbokeh.checks.findings import CheckReport, Finding
from mrbokeh.checks.shots import Shot
from mrbokeh.system.errors import InputError

Pair = tuple[CheckedPicture | str, CheckedPicture | None]

_SAME_TIME_S = 2e-3


def pairs(report: CheckReport, shot: Shot, plate: Shot | None, frames: tuple[int, int | None] = (0, None)) -> Iterator[Pair]:
    """Checked pictures with their plates, None where there is none. What the plate has and the shot lacks becomes a finding.

    frames: of the plate, counted from 0, from which the shot was made (the second is left out). Raises InputError where a picture
    of the plate cannot be read or is of another size.
    """
    _note_missing(report, shot.path.name, [str(number) for number in sorted(_missing_numbers(shot, plate, frames))])
    if plate is None:
        paired: Iterator[Pair] = ((picture, None) for picture in shot.pictures())
    elif not plate.is_sequence and len(plate.numbers or ()) == 1:
        still = _readable(next(plate.pictures()), plate)
        paired = ((picture, still) for picture in shot.pictures())
    elif shot.numbers is not None and plate.numbers is not None:
        paired = _by_number(shot, plate)
    elif shot.numbers is None and plate.numbers is None:
        paired = _by_time(report, shot, plate, frames)
    else:
        paired = _by_order(report, shot, plate, frames)
    for picture, other in paired:
        _require_same_size(picture, other)
        yield picture, other


def _missing_numbers(shot: Shot, plate: Shot | None, frames: tuple[int, int | None]) -> set[int]:
    missing = set(shot.missing)
    if plate is not None and plate.is_sequence == shot.is_sequence and shot.numbers is not None and len(plate.numbers or ()) > 1:
        missing |= set((plate.numbers or ())[slice(*frames)]) - set(shot.numbers)
    return missing


def _by_number(shot: Shot, plate: Shot) -> Iterator[Pair]:
    """Both are sorted; what only the plate has is passed over."""
    plates = zip(plate.numbers or (), plate.pictures(), strict=True)
    number, other = next(plates)
    for wanted, picture in zip(shot.numbers or (), shot.pictures(), strict=True):
        while number < wanted and (after := next(plates, None)) is not None:
            number, other = after
        yield picture, _readable(other, plate) if number == wanted else None


def _by_time(report: CheckReport, shot: Shot, plate: Shot, frames: tuple[int, int | None]) -> Iterator[Pair]:
    """Times of the shot count from the first frame taken of the plate, unless that is the plate's first."""
    plates = (_readable(each, plate) for each in islice(plate.pictures(), *frames))
    first = next(plates, None)
    if first is None or first.time_s is None:
        raise InputError(f"the plate {plate.path} has no frame {frames[0]}: give the range of its frames from which {shot.path} was made")
    start_s, other, passed = first.time_s if frames[0] else 0.0, first, list[str]()
    ended = False
    for picture in shot.pictures():
        time_s = start_s + (0.0 if isinstance(picture, str) or picture.time_s is None else picture.time_s)
        while not ended and (other.time_s or 0.0) < time_s - _SAME_TIME_S:
            passed.append(other.name)
            after = next(plates, None)
            other, ended = (other, True) if after is None else (after, False)
        if ended or (other.time_s or 0.0) > time_s + _SAME_TIME_S:
            yield picture, None
            continue
        yield picture, other
        after = next(plates, None)
        other, ended = (other, True) if after is None else (after, False)
    rest = [] if ended else [other.name, *(each.name for each in plates)]
    _note_missing(report, shot.path.name, [f"the plate's {each}" for each in (*passed, *rest)])


def _by_order(report: CheckReport, shot: Shot, plate: Shot, frames: tuple[int, int | None]) -> Iterator[Pair]:
    lacking = []
    for picture, other in zip_longest(shot.pictures(), islice(plate.pictures(), *frames)):
        if picture is not None:
            yield picture, None if other is None else _readable(other, plate)
        elif other is not None:
            lacking.append(f"the plate's {_readable(other, plate).name}")
    _note_missing(report, shot.path.name, lacking)


def _note_missing(report: CheckReport, where: str, names: list[str]) -> None:
    if names:
        text = f"{len(names)} pictures are missing: {', '.join(names[:12])}{' ...' if len(names) > 12 else ''}"
        report.findings.append(Finding("missing", where, text, float(len(names)), 0.0))


def _readable(picture: CheckedPicture | str, plate: Shot) -> CheckedPicture:
    if isinstance(picture, str):
        raise InputError(f"a picture of the plate {plate.path} cannot be read: {picture}")
    return picture


def _require_same_size(picture: CheckedPicture | str, plate: CheckedPicture | None) -> None:
    if not isinstance(picture, str) and plate is not None and picture.rgb.shape != plate.rgb.shape:
        (height, width), (rows, columns) = picture.rgb.shape[:2], plate.rgb.shape[:2]
        raise InputError(f"{picture.name} is {width}x{height} px, its plate {columns}x{rows} px: give the plate that it was made from")
