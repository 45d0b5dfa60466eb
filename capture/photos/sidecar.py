"""lens.toml beside the photographs: what their metadata lacks or tells wrongly.

    focal_length_mm = 35.0
    f_number = 1.8
    sensor_width_mm = 23.5          # of the whole photograph as it is stored, left to right
    blades = 7                      # a straight-bladed iris; without it the opening is round
    blade_rotation_rad = 0.2        # angle of its first corner, 0 = right, turning towards down
    obstruction = 0.5               # diameter of the stop in the middle of a mirror lens over that of its opening
    focus_origin = "lens"           # where focus distances count from: "lens" (default) or "film_plane"
    focus_distances_m = [0.5, 0.6, inf]     # in the order of the file names, one for each photograph of the folder

or, instead of the list,

    [focus_distances_m]
    "IMG_0001.NEF" = 0.5
"""

import math
import tomllib
from collections.abc import Sequence
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import Any

from capture.photos.focus_metadata import FocusReading
from capture.photos.photo_metadata import PhotoMetadata
from mrbokeh.aperture import Aperture
from mrbokeh.errors import InputError

FILE_NAME = "lens.toml"
_ORIGINS = ("lens", "film_plane")


@dataclass(frozen=True)
class Sidecar:
    """The content of a lens.toml; None and empty mean that it does not say. where: the file, for messages."""

    focal_length_mm: float | None = None
    f_number: float | None = None
    sensor_width_mm: float | None = None
    blades: int | None = None
    blade_rotation_rad: float = 0.0
    obstruction: float = 0.0
    focus_origin: str = "lens"
    focus_distances_m: tuple[float, ...] | dict[str, float] = ()
    where: str = field(default="", metadata={"key": False})

    @property
    def aperture(self) -> Aperture:
        opening = Aperture.disc() if self.blades is None else Aperture.blades(self.blades, self.blade_rotation_rad)
        return opening.obstructed(self.obstruction)

    def applied(self, names: Sequence[str], metadata: Sequence[PhotoMetadata]) -> list[PhotoMetadata]:
        """The metadata of all photographs of a folder (in the order of their names), with what the sidecar says instead."""
        focus = self._focus_readings(names)
        merged = [
            replace(each, focal_length_mm=self.focal_length_mm or each.focal_length_mm, f_number=self.f_number or each.f_number)
            for each in metadata
        ]
        return [replace(each, focus=focus[name]) if name in focus else each for name, each in zip(names, merged, strict=True)]

    def unmatched_names(self, names: Sequence[str]) -> list[str]:
        """File names that the focus table speaks of but the folder does not have: likely mistyped."""
        return sorted(set(self.focus_distances_m) - set(names)) if isinstance(self.focus_distances_m, dict) else []

    def _focus_readings(self, names: Sequence[str]) -> dict[str, FocusReading]:
        distances_m = self.focus_distances_m
        if not isinstance(distances_m, dict):
            if distances_m and len(distances_m) != len(names):
                raise InputError(
                    f"{self.where}: focus_distances_m lists {len(distances_m)} distances, but there are {len(names)} photographs "
                    f"({names[0]} .. {names[-1]}): give one for each, or a table [focus_distances_m] with file names"
                )
            distances_m = dict(zip(names, distances_m, strict=False))
        return {
            name: FocusReading(value, value, value, self.focus_origin, f"{Path(self.where).name} = {value:g} m")
            for name, value in distances_m.items()
        }


def find_sidecar(folder: Path, top: Path) -> Path | None:
    """The nearest lens.toml from the folder of the photographs upwards to `top`, the folder that the user named."""
    folder, top = folder.resolve(), top.resolve()
    searched = [folder, *(parent for parent in folder.parents if parent == top or top in parent.parents)]
    return next((each / FILE_NAME for each in searched if (each / FILE_NAME).is_file()), None)


def read_sidecar(path: Path) -> Sidecar:
    """A lens.toml. Raises InputError for unknown keys (naming the known ones) and for values that cannot be."""
    try:
        document = tomllib.loads(Path(path).read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise InputError(f"expected a sidecar file at {path}, but there is no such file") from None
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise InputError(f"{path} is not valid TOML: {error}") from None
    known = [each.name for each in fields(Sidecar) if each.metadata.get("key", True)]
    unknown = sorted(set(document) - set(known))
    if unknown:
        raise InputError(f"{path}: unknown key{'s' if len(unknown) > 1 else ''} {', '.join(unknown)}. Known are {', '.join(known)}")
    return Sidecar(**{key: _checked(key, value, path) for key, value in document.items()}, where=str(path))


def _checked(key: str, value: Any, path: Path) -> Any:
    """One value in its type, or InputError."""
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
            return {name: _positive(f"{key}.{name}", each, path, infinite=True) for name, each in value.items()}
        if isinstance(value, list):
            return tuple(_positive(key, each, path, infinite=True) for each in value)
        raise InputError(f"{path}: focus_distances_m must be a list of metres or a table of file names, got {value!r}")
    if key == "blade_rotation_rad":
        return _number(key, value, path)
    if key == "obstruction":
        share = _number(key, value, path)
        if not 0.0 <= share < 1.0:
            raise InputError(f"{path}: obstruction must be from 0 to below 1, got {value!r}")
        return share
    return _positive(key, value, path)


def _number(key: str, value: Any, path: Path) -> float:
    if isinstance(value, bool) or not isinstance(value, (int, float)) or math.isnan(value):
        raise InputError(f"{path}: {key} must be a number, got {value!r}")
    return float(value)


def _positive(key: str, value: Any, path: Path, *, infinite: bool = False) -> float:
    result = _number(key, value, path)
    if result <= 0 or (math.isinf(result) and not infinite):
        raise InputError(f"{path}: {key} must be positive{' (inf is allowed)' if infinite else ''}, got {value!r}")
    return result
