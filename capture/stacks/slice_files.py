"""Slices on disk: EXR files that carry a record of what they were made from, so that an interrupted ingest goes on where it was."""

import json
import os
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float32

from capture.stacks.disk_space import told_when_full
from mrbokeh.images.camera_rgb import Matrix3x3, write_camera_rgb

FOLDER = "slices"
_ATTRIBUTE = "mrbokehIngest"


def source_record(path: Path) -> dict[str, Any]:
    """Name, size and time of change of a photograph: whether it is still the file that a slice was made from."""
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
    with told_when_full(path, rgb.nbytes + saturated.nbytes):
        write_camera_rgb(path, rgb, rec709_from_camera, saturated=saturated, half=half, attributes={_ATTRIBUTE: json.dumps(record)})


def read_slice_record(path: Path) -> dict[str, Any] | None:
    """The record of a slice, from its header; None for other files."""
    import OpenEXR

    try:
        with OpenEXR.File(str(path), header_only=True) as file:
            text = file.header().get(_ATTRIBUTE)
        return json.loads(text) if isinstance(text, str) else None
    except (RuntimeError, OSError, ValueError):
        return None


def find_slices(stack_folder: Path) -> list[tuple[Path, dict[str, Any]]]:
    """The slices that ingest left in a stack's folder, finished or interrupted, with their records."""
    paths = sorted((stack_folder / FOLDER).glob("*.exr"))
    return [(path, record) for path in paths if not path.name.startswith(".") and (record := read_slice_record(path)) is not None]


def arrange_slices(stack_folder: Path, chosen: Sequence[Path]) -> list[Path]:
    """Rename the chosen slices to 00.exr, 01.exr, ... and delete those of ours that were not chosen.

    First out of the way, then to their places: interrupted halfway, every slice still exists under some name.
    """
    _delete(path for path, _ in find_slices(stack_folder) if path not in set(chosen))
    digits = max(2, len(str(len(chosen) - 1)))
    final = [stack_folder / FOLDER / f"{index:0{digits}d}.exr" for index in range(len(chosen))]
    if list(chosen) == final:
        return final
    aside = [path.with_name(f"moving_{index:04d}.exr") for index, path in enumerate(final)]
    for before, after in (*zip(chosen, aside, strict=True), *zip(aside, final, strict=True)):
        os.replace(before, after)
    return final


def _delete(paths: Iterable[Path]) -> None:
    for path in list(paths):
        path.unlink(missing_ok=True)
