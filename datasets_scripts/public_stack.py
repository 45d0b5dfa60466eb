"""What an adapter finds in the folder of a public data set, before any picture is read."""

import re
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from mrbokeh.images.image_io import INTEGER_SUFFIXES, LINEAR_SUFFIXES
from mrbokeh.stacks.focal_stack_dataset import Part
from mrbokeh.system.errors import InputError

_PICTURES = (*INTEGER_SUFFIXES, *LINEAR_SUFFIXES)
_F_NUMBER = re.compile(r"(?:^|[^a-z0-9])f[_/-]?(\d+(?:\.\d+)?)$", re.IGNORECASE)


@dataclass(frozen=True)
class PublicLens:
    """focal_length_mm None: nobody knows, the user must say."""

    focal_length_mm: float | None
    f_number: float
    sensor_width_mm: float


@dataclass(frozen=True)
class PublicSlice:
    """A photograph or rendering with blur.

    focus_distance_m: None where it has to be found from what is sharp. f_number, focal_length_mm: None as the lens of the set.
    px_per_dioptre: diameters of blur, at the width of the picture, where the set says it; else it follows from the lens.
    """

    path: Path
    focus_distance_m: float | None = None
    f_number: float | None = None
    focal_length_mm: float | None = None
    px_per_dioptre: float | None = None


@dataclass(frozen=True)
class PublicStack:
    """One viewpoint. name: SCENE/VIEW. key: what its file in a folder of depth maps is called. depth: a file of the set itself, metres.

    power: the pictures are linear to this power (a gamma without sRGB's toe); None: sRGB, or linear in EXR.
    """

    name: str
    part: Part
    key: str
    sharp: Path
    slices: tuple[PublicSlice, ...]
    depth: Path | None = None
    power: float | None = None
    facts: dict[str, Any] = field(default_factory=dict)


def pictures_in(folder: Path) -> list[Path]:
    """Sorted by number where names are numbers, else by name."""
    found = [path for path in folder.iterdir() if path.suffix.lower() in _PICTURES] if folder.is_dir() else []
    return sorted(found, key=lambda path: (int(path.stem) if path.stem.isdigit() else -1, path.name))


def unlike(source: Path, kind: str, expected: str) -> InputError:
    """The mistake of a folder that does not look like the set; layouts differ from version to version of a set."""
    return InputError(
        f"{source} does not look like {kind}: expected {expected}; versions of the set differ, so rename or link its folders to look so"
    )


def f_number_of(path: Path) -> float | None:
    """From a name that ends in it: f2.8.jpg, 12_f22.JPG, scene_f-16.png."""
    found = _F_NUMBER.search(path.stem)
    return float(found[1]) if found else None
