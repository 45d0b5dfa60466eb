"""shoot.json, the log of a bracket, and lens.toml, which states what its photographs do not.

The log is written after every photograph, so that a loose cable or Ctrl-C loses nothing:

    {"format": "mrbokeh-shoot", "version": 1, "camera": "...", "settings": {...}, "plan": {...}, "focus_steps": {...} or null,
     "slices": [{"index": 0, "file": "slice_00.nef", "camera_name": "DSC_0001.NEF", "bytes": 25165824, "steps": 180, ...}, ...],
     "check": {...} or null}
"""

import json
import math
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path
from typing import Any

from capture.photos.photo_files import PHOTO_SUFFIXES
from capture.photos.sidecar import LENS_FILE
from capture.tether.focus_plan import FocusPlan, plan_to_json
from mrbokeh.system.atomic_files import atomic_path, read_json, write_json
from mrbokeh.system.errors import InputError

_LOG_NAME = "shoot.json"
FORMAT = "mrbokeh-shoot"
VERSION = 1
_HEAD = "# written by mrbokeh capture shoot: what the photographs themselves do not state\n"


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
            self.folder / _LOG_NAME,
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
    """Return the log to continue, or a new one. Raises InputError if the folder holds another bracket or other photographs."""
    document = json.loads(json.dumps(plan_to_json(plan)))
    if overwrite:
        _remove(folder)
    if not (folder / _LOG_NAME).exists():
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
    """Read the log of a folder without slices whose files are missing or have changed."""
    path = folder / _LOG_NAME
    document = read_json(path, "the log of a shoot (shoot.json)")
    try:
        if (document["format"], document["version"]) != (FORMAT, VERSION):
            raise InputError(f"{path}: expected the log of a shoot of version {VERSION}, got {document['format']}, {document['version']}")
        slices = {int(each["index"]): each for each in document["slices"] if _is_there(folder, each)}
        check = document["check"] if len(slices) == len(document["slices"]) else None
        return ShootLog(
            folder=folder,
            plan=document["plan"],
            camera=document["camera"],
            settings=document["settings"],
            focus_steps=document["focus_steps"],
            slices=slices,
            check=check,
        )
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
    """Delete the photographs that an earlier log names, and the log; nothing else."""
    if not (folder / _LOG_NAME).exists():
        return
    for record in read_json(folder / _LOG_NAME, "the log of a shoot (shoot.json)").get("slices", []):
        (folder / str(record.get("file", "."))).unlink(missing_ok=True)
    (folder / _LOG_NAME).unlink()


def write_sidecar(log: ShootLog, plan: FocusPlan, *, planned_distances: bool = False) -> Path | None:
    """Write, renew or remove the shoot's lens.toml; return None if there is none of ours. A file that somebody else wrote is left alone.

    Focus distances are written if a photograph states none, if the stated ones do not distinguish the slices, since cameras round
    them, or always (planned_distances), which suits a motor whose scale was measured.
    """
    path = log.folder / LENS_FILE
    if path.exists() and not path.read_text(encoding="utf-8").startswith(_HEAD):
        return None
    lines = [*_lens_lines(log, plan), *([] if states_focus(log) and not planned_distances else _focus_lines(log))]
    if not lines:
        path.unlink(missing_ok=True)
        return None
    with atomic_path(path) as temporary:
        temporary.write_text(_HEAD + "\n".join(lines) + "\n", encoding="utf-8")
    return path


def states_focus(log: ShootLog) -> bool:
    """Tell whether the stated focus distances distinguish all slices."""
    stated = [each["stated"]["focus_dioptre"] for _, each in sorted(log.slices.items())]
    return None not in stated and all(near > far for near, far in pairwise(stated))


def _lens_lines(log: ShootLog, plan: FocusPlan) -> list[str]:
    stated: list[dict[str, Any]] = [each["stated"] for each in log.slices.values()]
    known = {"focal_length_mm": plan.lens.focal_length_mm, "f_number": plan.lens.f_number}
    lines = [f"{name} = {value!r}" for name, value in known.items() if not all(each[name] for each in stated)]
    return lines + ([] if all(each["sensor"] for each in stated) else [f"sensor_width_mm = {plan.lens.sensor_width_mm!r}"])


def _focus_lines(log: ShootLog) -> list[str]:
    rows = [f'"{each["file"]}" = {_metres(each["dioptre"])}' for _, each in sorted(log.slices.items())]
    return ['focus_origin = "lens"', "", "[focus_distances_m]", *rows]


def _metres(dioptre: float) -> str:
    return "inf" if dioptre <= 0.0 or math.isinf(1.0 / dioptre) else repr(round(1.0 / dioptre, 6))
