"""FocalStackDataset: many focal stacks as one data set, with its split, its radiance scale and the hash of every file.

DATASET/dataset.json is the manifest; DATASET/SCENE/VIEW/ are FocalStack folders (mrbokeh.stacks.focal_stack) whose exclusion.exr says
what not to learn from. Stacks are whole in one part: slices of a viewpoint share their all-in-focus picture, so that a split by
slices tests less than one by viewpoints. Only where there is a single stack, slices inside it are held out.
"""

import math
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, Literal

from mrbokeh.stacks.focal_stack import FocalStack, read_focal_stack
from mrbokeh.system.atomic_files import read_json, write_json
from mrbokeh.system.errors import InputError

FORMAT = "mrbokeh-focal-stack-dataset"
VERSION = 1
FILE_NAME = "dataset.json"

Part = Literal["train", "test"]
PARTS: tuple[Part, ...] = ("train", "test")


@dataclass(frozen=True)
class FileRecord:
    """Record of a file: sha256 (hexadecimal) and size."""

    sha256: str
    bytes: int


@dataclass(frozen=True)
class RadianceRange:
    """Linear Rec.709 of all-in-focus pictures and slices, largest channel, over the pixels that have data.

    quantiles: radiance by share of pixels, such as {"0.999": 3.2}, to half a percent.
    """

    largest: float
    quantiles: dict[str, float] = field(default_factory=dict)


@dataclass(frozen=True)
class StackRecord:
    """Stack of the data set. name: SCENE/VIEW, its folder in the data set.

    files: by path within the folder. excluded_shares: of the picture, by reason, and "any" for all together.
    largest_coc_px: the largest diameter over all slices, among pixels that are not excluded.
    held_out_slices: indices of those that are for testing although the stack is for training, because it is the only one.
    """

    name: str
    part: Part
    slices: int
    width_px: int
    height_px: int
    largest_coc_px: float
    radiance: RadianceRange
    excluded_shares: dict[str, float]
    files: dict[str, FileRecord]
    held_out_slices: tuple[int, ...] = ()


@dataclass(frozen=True)
class FocalStackDataset:
    """Data set of focal stacks.

    radiance_scale: radiance x goes into the network's range as 2 x / radiance_scale - 1, so that 0 is -1 and the scale itself is 1.
    licence: the text under which the pictures may be used.
    """

    folder: Path
    licence: str
    radiance_scale: float
    stacks: tuple[StackRecord, ...]
    metadata: dict[str, Any] = field(default_factory=dict)

    @property
    def largest_coc_px(self) -> float:
        return max(each.largest_coc_px for each in self.stacks)

    @property
    def network_blocks(self) -> int:
        return network_blocks(self.largest_coc_px)

    def records(self, part: Part) -> list[StackRecord]:
        return [each for each in self.stacks if each.part == part]

    def focal_stacks(self, part: Part) -> list[FocalStack]:
        """Return the stacks of a part; pictures are not opened."""
        return [read_focal_stack(self.folder / each.name) for each in self.records(part)]


def network_blocks(largest_coc_px: float) -> int:
    """Return N of Neural Bokeh (Mandl et al. 2024, section 3.1).

    The last of its blocks has a kernel 2 N + 1 wide, which covers the largest circle of confusion of the data.
    """
    return max(1, math.ceil((abs(largest_coc_px) - 1.0) / 2.0))


def slices_to_hold_out(stack: FocalStack) -> tuple[int, ...]:
    """Return which slices of the only stack are for testing: every fourth from the third on, in order of focus.

    Never an end of the focus range, which nothing else would show, and never the reference slice, whose place the next one takes, unless
    there are only three. About four fifths are left to train on; of two slices none is held out.
    """
    focus = [0.0 if distance is None else 1.0 / distance for distance in stack.focus_distances_m]
    order = sorted(range(len(stack)), key=lambda index: (focus[index], index))
    chosen = []
    for place in range(min(2, len(order) - 2), len(order) - 1, 4):
        if place > 0:
            inside = [each for each in (place, place + 1, place - 1) if 0 < each < len(order) - 1]
            chosen.append(next((order[each] for each in inside if order[each] != stack.reference), order[place]))
    return tuple(sorted(chosen))


def file_troubles(dataset: FocalStackDataset, record: StackRecord, sha256_of: Callable[[Path], str] | None = None) -> Iterator[str]:
    """Yield what of a stack is missing or changed, one sentence each; without sha256_of only sizes are compared."""
    for relative, expected in record.files.items():
        path = dataset.folder / record.name / relative
        if not path.is_file():
            yield f"{record.name}/{relative} is missing"
        elif path.stat().st_size != expected.bytes:
            yield f"{record.name}/{relative} has {path.stat().st_size} bytes, expected {expected.bytes}"
        elif sha256_of is not None and sha256_of(path) != expected.sha256:
            yield f"{record.name}/{relative} has another content than when it was written"


def write_focal_stack_dataset(dataset: FocalStackDataset) -> None:
    """Write dataset.json; the files it names must be there already."""
    document = {
        "format": FORMAT,
        "version": VERSION,
        "licence": dataset.licence,
        "radiance_scale": dataset.radiance_scale,
        "radiance_mapping": "linear Rec.709 x to the network as 2 x / radiance_scale - 1, and back",
        "largest_coc_px": dataset.largest_coc_px,
        "network_blocks": dataset.network_blocks,
        "split": {part: [each.name for each in dataset.records(part)] for part in PARTS},
        "slices_held_out_of_one_stack": {each.name: list(each.held_out_slices) for each in dataset.stacks if each.held_out_slices},
        "stacks": [record_to_json(each) for each in dataset.stacks],
        "metadata": dataset.metadata,
    }
    write_json(dataset.folder / FILE_NAME, document)


def read_focal_stack_dataset(folder: Path | str) -> FocalStackDataset:
    """Read the data set in a folder; pictures are not opened. Raises InputError if the folder is not one."""
    folder = Path(folder)
    document = read_json(folder / FILE_NAME, "a data set of focal stacks (made by `mrbokeh capture dataset`)")
    if not isinstance(document, dict) or document.get("format") != FORMAT or document.get("version") != VERSION:
        found = document if isinstance(document, dict) else {}
        raise InputError(
            f"{folder / FILE_NAME}: expected format {FORMAT!r} version {VERSION}, got {found.get('format')!r} version "
            f"{found.get('version')!r}: write the data set again with `mrbokeh capture dataset`"
        )
    try:
        return FocalStackDataset(
            folder=folder,
            licence=str(document["licence"]),
            radiance_scale=float(document["radiance_scale"]),
            stacks=tuple(record_from_json(each) for each in document["stacks"]),
            metadata=document["metadata"],
        )
    except (KeyError, TypeError, ValueError) as error:
        raise InputError(f"{folder / FILE_NAME} is incomplete ({error!r}): write it again with `mrbokeh capture dataset`") from None


def record_to_json(record: StackRecord) -> dict[str, Any]:
    document = asdict(record)
    return document if record.held_out_slices else {name: value for name, value in document.items() if name != "held_out_slices"}


def record_from_json(document: dict[str, Any]) -> StackRecord:
    """Read the record of a stack. Raises KeyError, TypeError or ValueError if something is missing."""
    if document["part"] not in PARTS:
        raise ValueError(f"part {document['part']!r}")
    files = {path: FileRecord(**each) for path, each in document["files"].items()}
    held_out = tuple(int(index) for index in document.get("held_out_slices", ()))
    return StackRecord(**document | {"files": files, "radiance": RadianceRange(**document["radiance"]), "held_out_slices": held_out})
