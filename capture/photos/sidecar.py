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

or a focus.csv (capture.photos.focus_csv).
"""

import tomllib
from collections.abc import Sequence
from dataclasses import dataclass, field, fields, replace
from pathlib import Path

from capture.photos import focus_csv
from capture.photos.focus_metadata import FocusReading
from capture.photos.photo_metadata import PhotoMetadata
from capture.photos.sidecar_values import checked
from capture.photos.stated_focus import StatedFocus
from mrbokeh.optics.aperture import Aperture
from mrbokeh.system.errors import InputError

FILE_NAME = "lens.toml"


@dataclass(frozen=True)
class Sidecar:
    """The content of a lens.toml and a focus.csv; None and empty mean that they do not say.

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
        """The metadata of all photographs of a folder (in the order of their names), with what the sidecar says instead."""
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
        """File names that the focus table speaks of but the folder does not have: likely mistyped."""
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
    """What lens.toml and focus.csv say of the photographs of a folder: the nearest from there upwards to `top`.

    given: the one file to read instead of those of its kind that lie beside the photographs; a lens.toml stands for both.
    """
    is_csv = given is not None and given.suffix.lower() == ".csv"
    toml_path = given if given is not None and not is_csv else find_sidecar(folder, top)
    csv_path = given if is_csv else find_sidecar(folder, top, focus_csv.FILE_NAME) if given is None else None
    sidecar = read_sidecar(toml_path) if toml_path is not None else Sidecar()
    if csv_path is None:
        return sidecar
    if sidecar.focus_distances_m:
        raise InputError(f"both {sidecar.where} and {csv_path} state focus distances: delete them from one of the two")
    return replace(sidecar, focus_distances_m=focus_csv.read_focus_csv(csv_path), focus_where=str(csv_path))


def find_sidecar(folder: Path, top: Path, file_name: str = FILE_NAME) -> Path | None:
    """The nearest lens.toml from the folder of the photographs upwards to `top`, the folder that the user named."""
    folder, top = folder.resolve(), top.resolve()
    searched = [folder, *(parent for parent in folder.parents if parent == top or top in parent.parents)]
    return next((each / file_name for each in searched if (each / file_name).is_file()), None)


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
    return Sidecar(**{key: checked(key, value, path) for key, value in document.items()}, where=str(path), focus_where=str(path))
