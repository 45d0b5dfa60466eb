"""Focus distances that cameras wrote for each frame, as tables (CSV).

    Sony Venice    "Focus Distance (ft)", "Aperture" as "T 2 3/10": 2^((2 + 0.3) / 2), as SMPTE's camdkit reads it
    RED            REDline --printMeta 5: "Focus Distance" in mm; "Aperture" is a T-number where the lens speaks Cooke /i, else an f-number
    Canon          "FocusPosition": the bits of a float in metres; "ApertureNumber" as a fraction, a T-number where ApertureMode is 2
    any            a column named focus or focus distance with its unit: focus_distance_m, Focus (mm), focus_ft, ...; f_number, t_number

Rows count as frames from 0 unless there is a column FrameNo or frame. Rows without a distance are bridged.
"""

import csv
import re
import struct
from collections.abc import Callable, Mapping, Sequence
from fractions import Fraction
from pathlib import Path

import numpy as np

from mrbokeh.system.errors import InputError
from mrbokeh.tracking.camera_track.focus_pull import FocusPull

Row = Mapping[str, str]

_METRES = {"m": 1.0, "cm": 0.01, "mm": 0.001, "ft": 0.3048, "in": 0.0254}
_HEADER = re.compile(r"focus[ _]?(?:distance|position)?[ _]?\(?(m|cm|mm|ft|in)\)?", re.IGNORECASE)
_SONY_STOP = re.compile(r"([TF]) ?([0-9]+)(?: ([0-9]+)/10)?")
_FRAME_COLUMNS = ("frame", "frameno", "frame_number")


def read_focus_pull(path: Path | str) -> FocusPull:
    """Raises InputError where no column or no row tells a focus distance."""
    path = Path(path)
    rows = _rows(path)
    distance_m = _distance_column(rows[0], path)
    distances = [_tried(distance_m, row, f"{path}, row {number}") for number, row in enumerate(rows, 1)]
    known = [index for index, each in enumerate(distances) if each is not None and each > 0.0]
    if not known:
        raise InputError(f"{path} has a column of focus distances, but none of its {len(rows)} rows tells one: the lens was not read")
    frames = np.array([_frame_number(rows[index], index, path) for index in known])
    dioptres = np.array([1.0 / (distances[index] or np.inf) for index in known])
    stops = [_stop(rows[index]) for index in known]
    f_numbers, t_numbers = (_numbers(stops, kind) for kind in "FT")
    return FocusPull(frames, dioptres, f_numbers=f_numbers, t_numbers=t_numbers, held=False)


def _rows(path: Path) -> list[Row]:
    try:
        with path.open(newline="", encoding="utf-8-sig") as file:
            rows: list[Row] = list(csv.DictReader(file))
    except FileNotFoundError:
        raise InputError(f"expected a table of focus distances at {path}, but there is no such file") from None
    except (csv.Error, UnicodeDecodeError) as error:
        raise InputError(f"expected a table (CSV) in {path}, but it is not one: {error}") from None
    if not rows:
        raise InputError(f"{path} holds no row: expected a header and a row for each frame")
    return rows


def _distance_column(row: Row, path: Path) -> Callable[[Row], float]:
    """What takes the metres out of a row."""
    for name in row:
        if name and (match := _HEADER.fullmatch(name.strip())):
            unit = _METRES[match[1].lower()]
            return lambda row: float(row[name]) * unit
    if "FocusPosition" in row:
        return lambda row: float(struct.unpack(">f", bytes.fromhex(row["FocusPosition"]))[0])
    if "Focus Distance" in row and "FrameNo" in row:
        return lambda row: float(row["Focus Distance"]) * _METRES["mm"]
    raise InputError(
        f"{path}: expected a column of focus distances with its unit, such as focus_distance_m or 'Focus Distance (ft)', "
        f"or a table of a Venice, RED or Canon; its columns are {', '.join(list(row)[:12])}"
    )


def _tried(distance_m: Callable[[Row], float], row: Row, where: str) -> float | None:
    """None where the row tells nothing; raises InputError where it tells what is no number."""
    try:
        return distance_m(row)
    except (ValueError, TypeError, struct.error) as error:
        if "empty" in str(error) or "convert string to float: ''" in str(error) or "NoneType" in str(error):
            return None
        raise InputError(f"{where}: its focus distance is not a number ({error})") from None


def _frame_number(row: Row, index: int, path: Path) -> float:
    for name in row:
        if name and name.strip().lower() in _FRAME_COLUMNS:
            try:
                return float(row[name])
            except ValueError:
                raise InputError(f"{path}, row {index + 1}: expected a frame number, got {row[name]!r}") from None
    return float(index)


def _stop(row: Row) -> tuple[str, float] | None:
    """("T" or "F", number), where the row tells it."""
    text = (row.get("Aperture") or "").strip()
    if match := _SONY_STOP.fullmatch(text):
        return match[1], float(2.0 ** ((int(match[2]) + int(match[3] or 0) / 10.0) / 2.0))
    cooke = bool((row.get("Cooke Metadata") or "").strip())
    canon = "T" if row.get("ApertureMode") == "2" else "F"
    for value, kind in (
        (text, "T" if cooke else "F"),
        (row.get("ApertureNumber"), canon),
        (row.get("f_number"), "F"),
        (row.get("t_number"), "T"),
    ):
        try:
            number = float(Fraction(value or "0"))
        except (ValueError, ZeroDivisionError):
            continue
        if number > 0.0:
            return kind, number
    return None


def _numbers(stops: Sequence[tuple[str, float] | None], kind: str) -> np.ndarray | None:
    """None unless every row tells that kind."""
    found = [each[1] for each in stops if each is not None and each[0] == kind]
    return np.array(found) if len(found) == len(stops) else None
