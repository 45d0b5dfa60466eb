"""The real stacks and pairs that lie in a folder: which files are one stack, and what their makers state about the focus.

The layout is that of the sets as they are copied out of their repositories (a folder per set); a folder of photographs that is none of
these sets is a stack as well, so that any collection can be measured.
"""

import hashlib
import re
from collections import defaultdict
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

PHOTOGRAPHS = (".jpg", ".jpeg", ".png", ".tif", ".tiff", ".bmp")
NOT_SLICES = ("reference_fused",)
"""File names that lie among the slices of a set and are none of them."""
FEWEST_PHOTOGRAPHS = 2
FUSED_BY_OTHERS, PUBLISHED_VALUES = "lytro_pairs_fused", "fusion_values"
OTHER_SETS = (
    "pixel4",
    "light_field_toy",
    "light_field_antinous",
    "clip_with_disparity",
    "photographs",
    "heic",
    FUSED_BY_OTHERS,
    PUBLISHED_VALUES,
)
"""Sets that hold no focus stacks."""
STACK_SETS = ("lytro_stacks", "balls", "pixel6_desk", "dice_and_glass", "bottle_outdoors", "depth_focal_stack", "few_slices")
PAIR_SET = "lytro_pairs"


@dataclass(frozen=True)
class RealStack:
    """name: SET or SET/STACK. stated_dioptres: the focus of each photograph as its makers state it, in any unit, or None."""

    name: str
    photographs: tuple[Path, ...]
    stated_dioptres: tuple[float, ...] | None = None

    @property
    def set_name(self) -> str:
        return self.name.split("/")[0]

    @property
    def is_pair(self) -> bool:
        return self.set_name == PAIR_SET

    @property
    def file_name(self) -> str:
        return self.name.replace("/", "_").replace(" ", "_")

    @cached_property
    def digest(self) -> str:
        """Of names and contents: the same photographs in another folder are the same stack."""
        found = hashlib.sha256()
        for path in self.photographs:
            found.update(path.name.encode() + hashlib.sha256(path.read_bytes()).digest())
        return found.hexdigest()[:16]


def find_stacks(data: Path) -> list[RealStack]:
    """Return every stack and pair in DATA, by name."""
    found = [*_numbered(data / "lytro_stacks"), *_balls(data / "balls"), *_named_by_metres(data / "pixel6_desk")]
    known = {"lytro_stacks", "balls", "pixel6_desk", *OTHER_SETS}
    if (data / PAIR_SET).is_dir():
        found += _folders(data / PAIR_SET, data)
    for folder in sorted(each for each in data.iterdir() if each.is_dir() and each.name not in known | {PAIR_SET}):
        if folder.name == "depth_focal_stack":
            found += _folder(folder / "Data", folder.name)
        else:
            found += _folders(folder, data)
    return sorted(found, key=lambda stack: _natural(stack.name))


def missing_sets(data: Path) -> list[str]:
    return [name for name in (*STACK_SETS, PAIR_SET, FUSED_BY_OTHERS, PUBLISHED_VALUES) if not (data / name).is_dir()]


def photographs_in(folder: Path) -> tuple[Path, ...]:
    if not folder.is_dir():
        return ()
    found = (path for path in folder.iterdir() if path.suffix.lower() in PHOTOGRAPHS and path.stem not in NOT_SLICES)
    return tuple(sorted(found, key=lambda path: _natural(path.name)))


def _folder(folder: Path, name: str) -> Iterator[RealStack]:
    photographs = photographs_in(folder)
    if len(photographs) >= FEWEST_PHOTOGRAPHS:
        yield RealStack(name, photographs)


def _folders(top: Path, data: Path) -> list[RealStack]:
    folders: Iterable[Path] = [top, *sorted(path for path in top.rglob("*") if path.is_dir())]
    return [stack for folder in folders for stack in _folder(folder, str(folder.relative_to(data)))]


def _numbered(folder: Path) -> Iterator[RealStack]:
    """Many stacks in one folder, N__refocus_KK.jpg."""
    stacks: dict[str, list[Path]] = defaultdict(list)
    for path in photographs_in(folder):
        stacks[path.name.split("__")[0]].append(path)
    yield from (RealStack(f"{folder.name}/{name}", tuple(paths)) for name, paths in stacks.items())


def _balls(folder: Path) -> Iterator[RealStack]:
    """focus_distance.txt states a distance for each photograph, in the unit of the set."""
    for stack in _folder(folder, folder.name):
        stated = folder / "focus_distance.txt"
        distances = [float(each) for each in stated.read_text(encoding="utf-8").split()] if stated.is_file() else []
        matching = len(distances) == len(stack.photographs)
        yield RealStack(stack.name, stack.photographs, tuple(1.0 / each for each in distances) if matching else None)


def _named_by_metres(folder: Path) -> Iterator[RealStack]:
    """image_K_METRES.jpg."""
    for stack in _folder(folder, folder.name):
        yield RealStack(stack.name, stack.photographs, tuple(1.0 / float(path.stem.split("_")[-1]) for path in stack.photographs))


def _natural(name: str) -> tuple[tuple[int, str], ...]:
    """Sort 2 before 10."""
    return tuple((int(part), "") if part.isdigit() else (-1, part) for part in re.split(r"(\d+)", name))
