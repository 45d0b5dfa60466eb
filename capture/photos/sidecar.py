"""lens.toml and focus.csv beside the photographs: what their metadata lacks or tells wrongly.

    focal_length_mm = 35.0
    f_number = 1.8
    sensor_width_mm = 23.5          # of the whole photograph as it is stored, left to right
    blades = 7                      # a straight-bladed iris; without it the opening is round
    blade_rotation_rad = 0.2        # angle of its first corner, 0 = right, turning towards down
    obstruction = 0.5               # diameter of the stop in the middle of a mirror lens over that of its opening
    focus_origin = "lens"           # where these focus distances count from: "lens" (its front principal plane) or "film_plane"
    hiatus_mm = 12.0                # distance between the principal planes of the lens; 0 unless given
    focus_distances_m = [0.5, [0.6, 0.58, 0.62], inf]   # in the order of the file names, one for each photograph of the folder;
                                    # three numbers are a distance with the nearest and the farthest that it may stand for

or, instead of the list,

    [focus_distances_m]
    "IMG_0001.NEF" = 0.5

or a focus.csv, for those who measured or logged the distances:

    file,focus_distance_m,nearest_m,farthest_m
    IMG_0001.NEF,0.50,0.48,0.52
    IMG_0002.NEF,0.60
    IMG_0003.NEF,inf

nearest_m and farthest_m say between which distances the true one lies; without them it is taken as exact.
"""

import csv
import math
import tomllib
from collections.abc import Sequence
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import Any

from capture.photos.focus_metadata import FocusReading
from capture.photos.photo_metadata import PhotoMetadata
from mrbokeh.optics.aperture import Aperture
from mrbokeh.system.errors import InputError, require_file

_ORIGINS = ("lens", "film_plane")
FOCUS_FILE = "focus.csv"
_NEEDED = ("file", "focus_distance_m")
_COLUMNS = (*_NEEDED, "nearest_m", "farthest_m")
LENS_FILE = "lens.toml"


@dataclass(frozen=True)
class StatedFocus:
    """Focus distance that the user gives, with the interval it stands for.

    0 < nearest_m <= distance_m <= farthest_m, inf allowed; all equal where it is exact.
    """

    distance_m: float
    nearest_m: float
    farthest_m: float

    @classmethod
    def checked(cls, values: Sequence[object], where: str) -> "StatedFocus":
        """Check a distance, or a distance with its nearest and farthest (None: exact). Raises InputError for impossible values."""
        given = [*values, None, None][:3]
        numbers = [given[0], *(given[0] if each is None else each for each in given[1:])]
        if any(isinstance(each, bool) or not isinstance(each, (int, float)) or math.isnan(each) for each in numbers):
            raise InputError(f"{where} must be a number of metres, or a distance with its nearest and farthest, got {_listed(values)}")
        distance_m, nearest_m, farthest_m = (float(each) for each in numbers if isinstance(each, (int, float)))
        if min(distance_m, nearest_m, farthest_m) <= 0:
            raise InputError(f"{where} must be positive (inf is allowed), got {_listed(values)}")
        if not nearest_m <= distance_m <= farthest_m:
            raise InputError(f"{where}: the distance must lie between its nearest and farthest, got {_listed(values)}")
        return cls(distance_m, nearest_m, farthest_m)

    def reading(self, origin: str, source: str) -> FocusReading:
        return FocusReading(self.distance_m, self.nearest_m, self.farthest_m, origin=origin, source=f"{source} = {self.distance_m:g} m")


@dataclass(frozen=True)
class Sidecar:
    """Content of a lens.toml and a focus.csv; None and empty mean that they do not say.

    where: the lens.toml; focus_where: the file that the distances come from; both for messages.
    """

    focal_length_mm: float | None = None
    f_number: float | None = None
    sensor_width_mm: float | None = None
    blades: int | None = None
    blade_rotation_rad: float = 0.0
    obstruction: float = 0.0
    focus_origin: str = "lens"
    hiatus_mm: float = 0.0
    focus_distances_m: tuple[StatedFocus, ...] | dict[str, StatedFocus] = ()
    where: str = field(default="", metadata={"key": False})
    focus_where: str = field(default="", metadata={"key": False})

    @property
    def aperture(self) -> Aperture:
        opening = Aperture.disc() if self.blades is None else Aperture.blades(self.blades, self.blade_rotation_rad)
        return opening.obstructed(self.obstruction)

    def applied(self, names: Sequence[str], metadata: Sequence[PhotoMetadata]) -> list[PhotoMetadata]:
        """Return the metadata of all photographs of a folder (in the order of their names), with what the sidecar says instead."""
        focus = self._focus_readings(names)
        merged = [
            replace(
                each,
                focal_length_mm=self.focal_length_mm or each.focal_length_mm,
                f_number=self.f_number or each.f_number,
                hiatus_mm=self.hiatus_mm,
            )
            for each in metadata
        ]
        return [replace(each, focus=focus[name]) if name in focus else each for name, each in zip(names, merged, strict=True)]

    def unmatched_names(self, names: Sequence[str]) -> list[str]:
        """Return file names that the focus table speaks of but the folder does not have: likely mistyped."""
        return sorted(set(self.focus_distances_m) - set(names)) if isinstance(self.focus_distances_m, dict) else []

    def _focus_readings(self, names: Sequence[str]) -> dict[str, FocusReading]:
        distances_m = self.focus_distances_m
        if not isinstance(distances_m, dict):
            if distances_m and len(distances_m) != len(names):
                raise InputError(
                    f"{self.focus_where}: focus_distances_m lists {len(distances_m)} distances, but there are {len(names)} photographs "
                    f"({names[0]} .. {names[-1]}): give one for each, or a table [focus_distances_m] with file names"
                )
            distances_m = dict(zip(names, distances_m, strict=False))
        return {name: stated.reading(self.focus_origin, Path(self.focus_where).name) for name, stated in distances_m.items()}


def sidecar_of(folder: Path, top: Path, given: Path | None = None) -> Sidecar:
    """Return what lens.toml and focus.csv say of the photographs of a folder: the nearest from there upwards to `top`.

    given: the one file to read instead of those of its kind that lie beside the photographs; a lens.toml stands for both.
    """
    is_csv = given is not None and given.suffix.lower() == ".csv"
    toml_path = given if given is not None and not is_csv else find_sidecar(folder, top)
    csv_path = given if is_csv else find_sidecar(folder, top, FOCUS_FILE) if given is None else None
    sidecar = read_sidecar(toml_path) if toml_path is not None else Sidecar()
    if csv_path is None:
        return sidecar
    if sidecar.focus_distances_m:
        raise InputError(f"both {sidecar.where} and {csv_path} state focus distances: delete them from one of the two")
    return replace(sidecar, focus_distances_m=read_focus_csv(csv_path), focus_where=str(csv_path))


def find_sidecar(folder: Path, top: Path, file_name: str = LENS_FILE) -> Path | None:
    """Return the nearest lens.toml from the folder of the photographs upwards to `top`, the folder that the user named."""
    folder, top = folder.resolve(), top.resolve()
    searched = [folder, *(parent for parent in folder.parents if parent == top or top in parent.parents)]
    return next((each / file_name for each in searched if (each / file_name).is_file()), None)


def read_sidecar(path: Path) -> Sidecar:
    """Read a lens.toml. Raises InputError for unknown keys (naming the known ones) and for impossible values."""
    require_file(path, "a sidecar file")
    try:
        document = tomllib.loads(Path(path).read_text(encoding="utf-8"))
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise InputError(f"{path} is not valid TOML: {error}") from None
    known = [each.name for each in fields(Sidecar) if each.metadata.get("key", True)]
    unknown = sorted(set(document) - set(known))
    if unknown:
        raise InputError(f"{path}: unknown key{'s' if len(unknown) > 1 else ''} {', '.join(unknown)}. Known are {', '.join(known)}")
    return Sidecar(**{key: checked(key, value, path) for key, value in document.items()}, where=str(path), focus_where=str(path))


def read_focus_csv(path: Path) -> dict[str, StatedFocus]:
    """Return the distances of a focus.csv by file name. Raises InputError naming the line that is wrong."""
    require_file(path, "focus distances")
    try:
        text = Path(path).read_text(encoding="utf-8-sig")
    except UnicodeDecodeError as error:
        raise InputError(f"{path} is not text in UTF-8: {error}") from None
    rows = csv.DictReader(text.splitlines(), skipinitialspace=True)
    names = [name.strip() for name in rows.fieldnames or []]
    rows.fieldnames = names
    if not set(_NEEDED) <= set(names) or not set(names) <= set(_COLUMNS):
        raise InputError(f"{path}: expected a first line {','.join(_COLUMNS)} (the last two may be left out), got {','.join(names)!r}")
    result: dict[str, StatedFocus] = {}
    for row in rows:
        where = f"{path}, line {rows.line_num}"
        name = (row["file"] or "").strip()
        if not name or name in result:
            raise InputError(f"{where}: expected the name of a file that was not named before, got {name!r}")
        result[name] = StatedFocus.checked([_cell(row.get(column)) for column in _COLUMNS[1:]], where)
    return result


def checked(key: str, value: Any, path: Path) -> Any:
    """Return a value of lens.toml in its type. Raises InputError."""
    if key == "focus_origin":
        if value not in _ORIGINS:
            raise InputError(f"{path}: focus_origin must be one of {', '.join(_ORIGINS)}, got {value!r}")
        return value
    if key == "blades":
        if not isinstance(value, int) or isinstance(value, bool) or value < 3:
            raise InputError(f"{path}: blades must be a whole number of at least 3, got {value!r}")
        return value
    if key == "focus_distances_m":
        if isinstance(value, dict):
            return {name: _stated(each, f"{path}: {key}.{name}") for name, each in value.items()}
        if isinstance(value, list):
            return tuple(_stated(each, f"{path}: {key}") for each in value)
        raise InputError(f"{path}: focus_distances_m must be a list of metres or a table of file names, got {value!r}")
    if key == "blade_rotation_rad":
        return _number(key, value, path)
    if key == "hiatus_mm":
        return _number(key, value, path)
    if key == "obstruction":
        share = _number(key, value, path)
        if not 0.0 <= share < 1.0:
            raise InputError(f"{path}: obstruction must be from 0 to below 1, got {value!r}")
        return share
    return _positive(key, value, path)


def _stated(value: Any, where: str) -> StatedFocus:
    return StatedFocus.checked(value if isinstance(value, list) and value else [value], where)


def _number(key: str, value: Any, path: Path) -> float:
    if isinstance(value, bool) or not isinstance(value, (int, float)) or math.isnan(value):
        raise InputError(f"{path}: {key} must be a number, got {value!r}")
    return float(value)


def _positive(key: str, value: Any, path: Path) -> float:
    result = _number(key, value, path)
    if result <= 0 or math.isinf(result):
        raise InputError(f"{path}: {key} must be positive, got {value!r}")
    return result


def _cell(text: str | None) -> str | float | None:
    """Return a number where it is one, else the text for the message; None for an empty cell."""
    stripped = (text or "").strip()
    try:
        return float(stripped) if stripped else None
    except ValueError:
        return stripped


def _listed(values: Sequence[object]) -> str:
    return ", ".join(str(each) for each in values if each is not None) or "nothing"
