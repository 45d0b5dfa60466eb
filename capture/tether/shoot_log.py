"""shoot.json: what was shot so far, written after every photograph, so that a torn cable or Ctrl-C costs nothing.

{"format": "mrbokeh-shoot", "version": 1, "camera": "...", "settings": {...}, "plan": {...}, "focus_steps": {...} or null,
 "slices": [{"index": 0, "file": "slice_00.nef", "camera_name": "DSC_0001.NEF", "bytes": 25165824, "steps": 180, ...}, ...],
 "check": {...} or null}
"""

import json
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from capture.photos.photo_files import PHOTO_SUFFIXES
from capture.tether.focus_plan import FocusPlan
from capture.tether.plan_file import plan_to_json
from mrbokeh.system.atomic_files import read_json, write_json
from mrbokeh.system.errors import InputError

FILE_NAME = "shoot.json"
FORMAT = "mrbokeh-shoot"
VERSION = 1


@dataclass
class ShootLog:
    """The log of one bracket in its folder. slices: one record each, by index."""

    folder: Path
    plan: dict[str, Any]
    camera: str
    settings: dict[str, str] = field(default_factory=dict)
    focus_steps: dict[str, Any] | None = None
    slices: dict[int, dict[str, Any]] = field(default_factory=dict)
    check: dict[str, Any] | None = None

    def add(self, record: dict[str, Any]) -> None:
        self.slices[record["index"]] = record
        # What was compared belongs to the slices that were there.
        self.check = None
        self.write()

    def write(self) -> None:
        write_json(
            self.folder / FILE_NAME,
            {
                "format": FORMAT,
                "version": VERSION,
                "camera": self.camera,
                "settings": self.settings,
                "plan": self.plan,
                "focus_steps": self.focus_steps,
                "slices": [self.slices[index] for index in sorted(self.slices)],
                "check": self.check,
            },
        )


def open_log(folder: Path, plan: FocusPlan, camera: str, *, overwrite: bool) -> ShootLog:
    """The log to go on with, or a new one. Raises InputError where the folder holds another bracket or other photographs."""
    document = json.loads(json.dumps(plan_to_json(plan)))
    if overwrite:
        _remove(folder)
    if not (folder / FILE_NAME).exists():
        _require_no_strangers(folder)
        return ShootLog(folder, document, camera)
    log = read_log(folder)
    for what, kept, now in (("plan", log.plan, document), ("camera", log.camera, camera)):
        if kept != now:
            raise InputError(
                f"{folder} holds a shoot with another {what}{f' ({kept}, now {now})' if what == 'camera' else ''}: "
                f"give another --out, or --overwrite to shoot it again"
            )
    return log


def read_log(folder: Path) -> ShootLog:
    """The log of a folder, without slices whose files are gone or not what they were."""
    path = folder / FILE_NAME
    document = read_json(path, "the log of a shoot (shoot.json)")
    try:
        if (document["format"], document["version"]) != (FORMAT, VERSION):
            raise InputError(f"{path}: expected the log of a shoot of version {VERSION}, got {document['format']}, {document['version']}")
        slices = {int(each["index"]): each for each in document["slices"] if _is_there(folder, each)}
        check = document["check"] if len(slices) == len(document["slices"]) else None
        return ShootLog(folder, document["plan"], document["camera"], document["settings"], document["focus_steps"], slices, check)
    except (KeyError, TypeError, AttributeError) as error:
        raise InputError(f"{path}: this log is damaged ({error!r}): give another --out, or --overwrite to shoot it again") from None


def _is_there(folder: Path, record: dict[str, Any]) -> bool:
    path = folder / record["file"]
    return path.is_file() and path.stat().st_size == record["bytes"]


def _require_no_strangers(folder: Path) -> None:
    found = [path.name for path in folder.glob("*") if path.suffix.lower() in PHOTO_SUFFIXES and not path.name.startswith(".")]
    if found:
        raise InputError(f"{folder} holds photographs that are not of this shoot ({sorted(found)[0]} ...): give an empty folder as --out")


def _remove(folder: Path) -> None:
    """The photographs that an earlier log names, and the log; nothing else."""
    if not (folder / FILE_NAME).exists():
        return
    for record in read_json(folder / FILE_NAME, "the log of a shoot (shoot.json)").get("slices", []):
        (folder / str(record.get("file", "."))).unlink(missing_ok=True)
    (folder / FILE_NAME).unlink()
