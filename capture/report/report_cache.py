"""Findings of a stack kept in its folder: an interrupted report goes on, and pictures wait on disk until a page is written.

STACK/report holds found.json, the pictures of the page as JPEG, and moving.png. found.json comes last and names what it was found from.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from jaxtyping import Bool

from capture.merging.registration.registration_file import FILE_NAME as REGISTRATION_FILE
from capture.report.examination import Examination
from capture.report.findings import StackFindings, findings_document, findings_from
from capture.report.pictures import Shown, ShownPlace
from capture.report.stack_view import Reblur
from mrbokeh.stacks.focal_stack import FILE_NAME as STACK_FILE
from mrbokeh.stacks.focal_stack import FocalStack
from mrbokeh.system.atomic_files import atomic_path, read_json, write_json
from mrbokeh.system.errors import InputError
from mrbokeh.system.html_page import inline_figure

Mask = Bool[np.ndarray, "height width"]
Signature = dict[str, Any]

FOLDER, JSON_NAME, MOVING_NAME = "report", "found.json", "moving.png"
VERSION = 5
"""A number that rises whenever other numbers or pictures would be found in the same stack."""


@dataclass(frozen=True)
class CachedPicture:
    """JPEG file and what it shows."""

    path: Path
    caption: str

    def html(self) -> str:
        return inline_figure(self.path.read_bytes(), "jpeg", self.caption)


@dataclass(frozen=True)
class CachedPlace:
    """Place where the merged picture is worst for a gate. at_px: x, y of the first pixel of a block."""

    gate: str
    at_px: tuple[int, int]
    caption: str
    pictures: tuple[CachedPicture, ...]


@dataclass(frozen=True)
class CachedExamination:
    """Findings in memory; pictures, those of the worst places, and moving_path where anybody knows what moved, on disk."""

    findings: StackFindings
    pictures: tuple[CachedPicture, ...]
    places: tuple[CachedPlace, ...]
    moving_path: Path | None

    def moving(self) -> Mask | None:
        """Return (H, W) at the width of the report."""
        if self.moving_path is None:
            return None
        levels = cv2.imread(str(self.moving_path), cv2.IMREAD_GRAYSCALE)
        if levels is None:
            raise InputError(f"{self.moving_path}: expected a PNG, but it is none: run `mrbokeh capture report --overwrite`")
        return np.asarray(levels > 0)


def signature_of(stack: FocalStack, reblur: Reblur, widest_px: int) -> Signature:
    """Return what changes when something does that findings depend on."""
    names = [STACK_FILE, REGISTRATION_FILE, stack.all_in_focus_path.name, stack.depth_path.name, *(each.path for each in stack.slices)]
    files = {name: _state(stack.folder / name) for name in names}
    return {"version": VERSION, "width_px": widest_px, "renderer": reblur.identity, "files": files}


def write_cache(
    stack: FocalStack, signature: Signature, examination: Examination, pictures: Sequence[Shown], places: Sequence[ShownPlace]
) -> CachedExamination:
    """Write what was found, in place of what was kept before. signature: taken before the stack was examined."""
    folder = stack.folder / FOLDER
    _forget(folder)
    listed = _written(folder, "picture", pictures)
    crops = [_written(folder, f"picture_place_{number:02d}", each.pictures) for number, each in enumerate(places)]
    if examination.moving is not None:
        _write(folder / MOVING_NAME, cv2.imencode(".png", np.where(examination.moving, np.uint8(255), np.uint8(0)))[1].tobytes())
    document = {
        "signature": signature,
        "findings": findings_document(examination.findings),
        "pictures": listed,
        "places": [
            {"gate": each.place.gate, "at_px": list(each.place.at_px), "caption": each.place.caption, "pictures": files}
            for each, files in zip(places, crops, strict=True)
        ],
        "moving": None if examination.moving is None else MOVING_NAME,
    }
    write_json(folder / JSON_NAME, document)
    return _from_document(document, stack)


def read_cache(stack: FocalStack, signature: Signature) -> CachedExamination | None:
    """Return what was found in just this way, else None; what cannot be read, or misses a picture, is found again."""
    path = stack.folder / FOLDER / JSON_NAME
    try:
        document = read_json(path, "the findings of a stack")
        if document["signature"] != signature:
            return None
        found = _from_document(document, stack)
    except (InputError, KeyError, TypeError, ValueError):
        return None
    pictures = [*found.pictures, *(picture for place in found.places for picture in place.pictures)]
    files = [*(each.path for each in pictures), *([found.moving_path] if found.moving_path else [])]
    return found if all(each.is_file() for each in files) else None


def _from_document(document: dict[str, Any], stack: FocalStack) -> CachedExamination:
    folder = stack.folder / FOLDER
    places = tuple(
        CachedPlace(each["gate"], (int(each["at_px"][0]), int(each["at_px"][1])), each["caption"], _pictures_from(each["pictures"], folder))
        for each in document["places"]
    )
    moving_path = None if document["moving"] is None else folder / document["moving"]
    return CachedExamination(findings_from(document["findings"], stack), _pictures_from(document["pictures"], folder), places, moving_path)


def _pictures_from(listed: list[dict[str, Any]], folder: Path) -> tuple[CachedPicture, ...]:
    return tuple(CachedPicture(folder / each["file"], each["caption"]) for each in listed)


def _written(folder: Path, name: str, pictures: Sequence[Shown]) -> list[dict[str, Any]]:
    """Write pictures and return their files and captions."""
    listed = [{"file": f"{name}_{number:02d}.jpg", "caption": each.caption} for number, each in enumerate(pictures)]
    for entry, each in zip(listed, pictures, strict=True):
        _write(folder / entry["file"], each.jpeg)
    return listed


def _forget(folder: Path) -> None:
    """Delete found.json first, so that it never stands beside pictures that are not its own."""
    for path in (folder / JSON_NAME, folder / MOVING_NAME, *folder.glob("picture_*.jpg")):
        path.unlink(missing_ok=True)


def _state(path: Path) -> list[int] | None:
    """Return size and time of a file; None where there is none."""
    if not path.is_file():
        return None
    status = path.stat()
    return [status.st_size, status.st_mtime_ns]


def _write(path: Path, data: bytes) -> None:
    with atomic_path(path) as temporary:
        temporary.write_bytes(data)
