"""Slices on disk: EXR files that carry a record of what they were made from, so that an interrupted ingest goes on where it was.

stack.json keeps of each photograph its shooting data, focus as stated, exposure and white balance as applied. Some cameras state
infinity by a sentinel: taken as infinity to start from, but not known. How far such slices may be off follows from the stack alone: they
come after all those that state real distances, since a camera writes the sentinel for what lies beyond its last code. So the distance
lies anywhere from the farthest real one to infinity. The hyperfocal distance would be a narrower bound, but depends on what blur one calls
sharp and on nothing that the camera has said. A distance of a lens.toml or focus.csv is no sentinel, `inf` included.
"""

import errno
import json
import math
import os
import shutil
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float32

from capture.photos.photo_metadata import PhotoMetadata
from capture.photos.raw import DecodedPhoto
from capture.stacks.exposure import ExposureGain
from capture.stacks.grouping import Photo
from mrbokeh.images.camera_rgb import Matrix3x3, write_camera_rgb
from mrbokeh.stacks.focal_stack import FocalStack
from mrbokeh.system.errors import InputError

_FULL = (errno.ENOSPC, errno.EDQUOT)
_MIB = 2**20
FOLDER = "slices"
_ATTRIBUTE = "mrbokehIngest"


class DiskFullError(InputError):
    """Error that stops all work: nothing can be written any more, and going on with the next file would not help."""


@contextmanager
def reporting_full_disk(path: Path, needed_bytes: int = 0) -> Iterator[None]:
    """Turn a write that fails for want of space into DiskFullError.

    Libraries in C++ say so in words at best: otherwise it is the disk if it has less left than needed_bytes.
    """
    try:
        yield
    except OSError as error:
        if error.errno not in _FULL:
            raise
        raise DiskFullError(_message(path)) from None
    except RuntimeError as error:
        said = any(os.strerror(code) in str(error) for code in _FULL)
        if not said and shutil.disk_usage(_existing(path)).free >= needed_bytes:
            raise
        raise DiskFullError(_message(path)) from None


def source_record(path: Path) -> dict[str, Any]:
    """Return name, size and time of change of a photograph: whether it is still the file that a slice was made from."""
    status = path.stat()
    return {"source": path.name, "source_size_bytes": status.st_size, "source_mtime_ns": status.st_mtime_ns}


def write_slice(
    path: Path,
    rgb: Float32[np.ndarray, "height width 3"],
    saturated: Float32[np.ndarray, "height width"],
    rec709_from_camera: Matrix3x3 | None,
    record: dict[str, Any],
    *,
    half: bool,
) -> None:
    """Write a linear slice with its saturation mask and its record, atomically. Raises DiskFullError."""
    with reporting_full_disk(path, rgb.nbytes + saturated.nbytes):
        write_camera_rgb(path, rgb, rec709_from_camera, saturated=saturated, half=half, attributes={_ATTRIBUTE: json.dumps(record)})


def read_slice_record(path: Path) -> dict[str, Any] | None:
    """Read the record of a slice from its header; None for other files."""
    import OpenEXR

    try:
        with OpenEXR.File(str(path), header_only=True) as file:
            text = file.header().get(_ATTRIBUTE)
        return json.loads(text) if isinstance(text, str) else None
    except (RuntimeError, OSError, ValueError):
        return None


def find_slices(stack_folder: Path) -> list[tuple[Path, dict[str, Any]]]:
    """Find the slices that ingest left in a stack's folder, finished or interrupted, with their records."""
    paths = sorted((stack_folder / FOLDER).glob("*.exr"))
    return [(path, record) for path in paths if not path.name.startswith(".") and (record := read_slice_record(path)) is not None]


def arrange_slices(stack_folder: Path, chosen: Sequence[Path]) -> list[Path]:
    """Rename the chosen slices to 00.exr, 01.exr, ... and delete those of ours that were not chosen.

    First out of the way, then to their places: interrupted halfway, every slice still exists under some name.
    """
    for path, _ in find_slices(stack_folder):
        if path not in set(chosen):
            path.unlink(missing_ok=True)
    digits = max(2, len(str(len(chosen) - 1)))
    final = [stack_folder / FOLDER / f"{index:0{digits}d}.exr" for index in range(len(chosen))]
    if list(chosen) == final:
        return final
    aside = [path.with_name(f"moving_{index:04d}.exr") for index, path in enumerate(final)]
    for before, after in (*zip(chosen, aside, strict=True), *zip(aside, final, strict=True)):
        os.replace(before, after)
    return final


def slice_metadata(photo: Photo, decoded: DecodedPhoto, gain: ExposureGain) -> dict[str, Any]:
    """Return JSON-ready metadata of a slice. Distances that may be infinite are given in dioptres (1/m), for which JSON has numbers.

    saturated_fraction: share of the photosites that were full. saturation_level: the value of a full grey in the slice.
    """
    metadata = photo.metadata
    level = decoded.saturation_level
    return {
        "exposure_time_s": metadata.exposure_time_s,
        "iso": metadata.iso,
        "f_number": metadata.f_number,
        "focal_length_mm": metadata.focal_length_mm,
        "taken_at": metadata.taken_at.isoformat() if metadata.taken_at else None,
        "camera_model": metadata.camera_model,
        "lens_model": metadata.lens_model,
        "orientation": metadata.orientation,
        "lens_position": metadata.lens_position,
        "focus": focus_record(metadata),
        "white_balance": None if decoded.white_balance is None else list(decoded.white_balance),
        "exposure_gain": gain.total,
        "exposure_gain_session": gain.session,
        "exposure_gain_session_from": gain.session_from,
        "exposure_gain_stated": gain.stated,
        "exposure_gain_measured": None if gain.measured is None else gain.stated * gain.measured,
        "saturated_fraction": decoded.photosites.full_fraction if level is not None else None,
        "saturation_level": None if level is None else level * gain.total,
    }


def focus_record(metadata: PhotoMetadata) -> dict[str, Any] | None:
    """Return the focus distance as the file stated it, and counted from the lens; intervals are what the statement may stand for.

    The lens's are None where its focal length is unknown or no lens of that length focuses so near. sentinel: nothing is known of this
    distance but what the rest of the stack tells (`bounded_focus_records`).
    """
    focus = metadata.focus
    if focus is None:
        return None
    distance_m, interval_m = metadata.focus_distance_m, metadata.focus_interval_m
    return {
        "source": focus.source,
        "origin": focus.origin,
        "sentinel": focus.is_sentinel,
        "stated_dioptre": 1.0 / focus.distance_m,
        "interval_dioptre": [1.0 / focus.farthest_m, 1.0 / focus.nearest_m],
        "hiatus_mm": metadata.hiatus_mm,
        "lens_dioptre": None if distance_m is None else 1.0 / distance_m,
        "lens_interval_dioptre": None if interval_m is None else [1.0 / interval_m[1], 1.0 / interval_m[0]],
    }


def bounded_focus_records(metadata: Sequence[PhotoMetadata]) -> list[dict[str, Any] | None]:
    """Return `focus_record` of the photographs of a stack, with the intervals of sentinels bounded by the stack.

    They reach from infinity to the farthest real distance from the lens, and are None where there is none.
    """
    known_m = [distance for each in metadata if not _by_sentinel(each) and (distance := each.focus_distance_m) and math.isfinite(distance)]
    interval = [0.0, 1.0 / max(known_m)] if known_m else None
    bounded = {"interval_dioptre": interval, "lens_interval_dioptre": interval}
    records = ((each, focus_record(each)) for each in metadata)
    return [record | bounded if record is not None and _by_sentinel(each) else record for each, record in records]


def stated_by_sentinel(stack: FocalStack) -> Bool[np.ndarray, " slices"]:
    """Return the slices whose camera stated no distance but a sentinel, whatever a calibration has found since."""
    return np.array([bool((each.metadata.get("focus") or {}).get("sentinel", False)) for each in stack.slices], bool)


def _existing(path: Path) -> Path:
    return next(each for each in (path, *path.parents) if each.exists())


def _message(path: Path) -> str:
    free_mib = shutil.disk_usage(_existing(path)).free / _MIB
    return (
        f"the disk of {path.parent} is full ({free_mib:.0f} MiB left): make room or give another --out, then run the same command again; "
        f"finished slices are kept"
    )


def _by_sentinel(metadata: PhotoMetadata) -> bool:
    return metadata.focus is not None and metadata.focus.is_sentinel
