"""Files of a shoot: its photographs, shoot.json, the log of a bracket, and lens.toml, which states what the photographs do not.

The log is written after every photograph, so that a loose cable or Ctrl-C loses nothing:

    {"format": "mrbokeh-shoot", "version": 1, "camera": "...", "settings": {...}, "plan": {...}, "focus_steps": {...} or null,
     "slices": [{"index": 0, "file": "slice_00.nef", "camera_name": "DSC_0001.NEF", "bytes": 25165824, "steps": 180, ...}, ...],
     "check": {...} or null}

The check tells whether the focus came back at the end. Blur shows in the energy of fine detail: over the tiles of the picture, the second
slice differs from the first in a pattern of gains and losses. The first slice is shot again at the end; the amount of that pattern in
it is its focus error as a fraction of the gap between two slices: positive towards the second, negative away from it. Blur of less than a
pixel does not show, so errors below half a gap are underestimated by up to one half; without an error, noise gives less than 0.01.
"""

import json
import math
from dataclasses import asdict, dataclass, field
from itertools import pairwise
from pathlib import Path, PurePath
from typing import Any

import cv2
import numpy as np
from jaxtyping import Float32, Float64

from capture.merging.focus_volume import focus_energy
from capture.photos.developing import develop, is_raw
from capture.photos.metadata import read_metadata
from capture.photos.photo_files import PHOTO_SUFFIXES
from capture.photos.photo_metadata import PhotoMetadata
from capture.photos.raw import read_raw_metadata
from capture.photos.sidecar import LENS_FILE
from capture.stacks.slice_files import focus_record
from capture.tether.camera_driver import CameraError, Shot
from capture.tether.focus_plan import FocusPlan, plan_to_json
from capture.tether.watched_folder import is_whole
from mrbokeh.images.color import luminance
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


# EXIF rounds exposure times; a third of a stop is 26 %.
_SAME_EXPOSURE = 0.03
WIDTH_PX = 960
LARGEST_FOCUS_ERROR = 0.15
LARGEST_SHIFT_PX = 2.0
LARGEST_BRIGHTNESS_ERROR = 0.02
_TILES = (16, 24)
_FLOOR = 0.05
Rgb = Float32[np.ndarray, "height width 3"]


@dataclass(frozen=True)
class SavedShot:
    """A photograph of a shoot and its shooting data."""

    path: Path
    shot: Shot
    metadata: PhotoMetadata

    def record(self) -> dict[str, Any]:
        """Return what the log keeps: JSON-ready, distances in metres as `focus_distance_m` from the lens, None if unknown."""
        metadata = self.metadata
        return {
            "file": self.path.name,
            "camera_name": self.shot.name,
            "bytes": len(self.shot.data),
            "steps": self.shot.steps,
            "stated": {
                "focus": focus_record(metadata),
                "focus_dioptre": None if metadata.focus_distance_m is None else 1.0 / metadata.focus_distance_m,
                "focal_length_mm": metadata.focal_length_mm,
                "f_number": metadata.f_number,
                "exposure_time_s": metadata.exposure_time_s,
                "iso": metadata.iso,
                "sensor": None if metadata.sensor is None else metadata.sensor.source,
            },
        }


def save_shot(shot: Shot, folder: Path, stem: str) -> SavedShot:
    """Write a shot under a stem with the suffix the camera gave it. Raises CameraError if it did not arrive whole."""
    suffix = PurePath(shot.name).suffix.lower()
    if suffix not in PHOTO_SUFFIXES:
        raise CameraError(f"the camera sent {shot.name}, which is no photograph: set it to RAW")
    path = folder / f"{stem}{suffix}"
    with atomic_path(path) as temporary:
        temporary.write_bytes(shot.data)
        if not is_whole(temporary):
            raise CameraError(f"{shot.name} did not arrive whole ({len(shot.data)} bytes): run the same command again")
        metadata = read_metadata(temporary)
        metadata = metadata.filled_from(read_raw_metadata(temporary)) if is_raw(temporary) else metadata
    return SavedShot(path, shot, metadata)


def require_same_exposure(first: dict[str, Any], now: dict[str, Any]) -> None:
    """Raise CameraError if two records state different exposures: the camera chose by itself."""
    for name in ("exposure_time_s", "iso", "f_number"):
        kept, new = first["stated"][name], now["stated"][name]
        if kept and new and abs(new / kept - 1.0) > _SAME_EXPOSURE:
            raise CameraError(
                f"{now['camera_name']} was exposed otherwise than the first slice ({name} {new:g}, not {kept:g}) and is not taken: "
                f"set the camera to manual exposure with a fixed ISO and run the same command again"
            )


@dataclass(frozen=True)
class ReturnCheck:
    """Comparison of the first slice with its repetition at the end.

    focus_error: fraction of a slice's gap, None if there is only one slice. shift_px: in pixels of the photograph.
    brightness: mean light of the repetition over that of the first.
    """

    focus_error: float | None
    shift_px: float
    brightness: float

    @property
    def warnings(self) -> list[str]:
        found = []
        if self.focus_error is not None and abs(self.focus_error) > LARGEST_FOCUS_ERROR:
            found.append(
                f"the focus did not come back: slice 0 shot again is off by {self.focus_error:+.2f} of the gap to slice 1. "
                f"Somebody touched the ring, or the play is larger than --backlash: shoot again"
            )
        if self.shift_px > LARGEST_SHIFT_PX:
            found.append(f"the camera moved: slice 0 shot again is shifted by {self.shift_px:.1f} px (registration can undo it)")
        if abs(self.brightness - 1.0) > LARGEST_BRIGHTNESS_ERROR:
            found.append(f"the light changed: slice 0 shot again is {self.brightness:.2f} times as bright")
        return found

    def to_json(self) -> dict[str, Any]:
        return asdict(self) | {"warnings": self.warnings}


def check_return(first: Path, repeated: Path, second: Path | None) -> ReturnCheck:
    """Compare photographs of one size. second: the slice next to the first, None if there is only one."""
    reference, scale = _reduced(first)
    again = _reduced(repeated)[0]
    error = None if second is None else focus_error(reference, again, _reduced(second)[0])
    before, after = (np.sqrt(luminance(each)).astype(np.float64) for each in (reference, again))
    (shift_x, shift_y), _ = cv2.phaseCorrelate(before, after, _window(again))
    return ReturnCheck(error, float(np.hypot(shift_x, shift_y)) * scale, float(again.mean() / max(float(reference.mean()), 1e-9)))


def focus_error(first: Rgb, repeated: Rgb, second: Rgb) -> float:
    """Return how far from `first` towards `second` the focus of `repeated` is: least squares over the logarithms of tile energies."""
    start, now, end = (_log_energies(each) for each in (first, repeated, second))
    way = end - start
    return float((way * (now - start)).sum() / max(float((way * way).sum()), 1e-12))


def _reduced(path: Path) -> tuple[Rgb, float]:
    """Return the photograph at most WIDTH_PX wide, and the original pixels per pixel of it."""
    decoded = develop(path, None, half_size=is_raw(path), max_width=WIDTH_PX)
    return decoded.rgb, decoded.photosites.width / decoded.rgb.shape[1]


def _log_energies(rgb: Rgb) -> Float64[np.ndarray, "rows columns"]:
    tiles = cv2.resize(focus_energy(rgb), _TILES[::-1], interpolation=cv2.INTER_AREA).astype(np.float64)
    # Where there is no detail, noise must not count.
    return np.log(tiles + _FLOOR * float(tiles.mean()) + 1e-12)


def _window(rgb: Rgb) -> Float64[np.ndarray, "height width"]:
    height, width = rgb.shape[:2]
    return cv2.createHanningWindow((width, height), cv2.CV_64F)
