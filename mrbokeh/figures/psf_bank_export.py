"""The kernels of a bank as pictures, for a convolution in Nuke, OpenDefocus or Blender."""

import csv
from pathlib import Path
from typing import Literal

import numpy as np

from mrbokeh.images.image_io import write_image
from mrbokeh.optics.psf_bank import PsfBank
from mrbokeh.system.atomic_files import atomic_path
from mrbokeh.system.console import track
from mrbokeh.system.errors import InputError


def export_bank(bank: PsfBank, folder: Path | str, suffix: Literal["exr", "png"], overwrite: bool = False) -> int:
    """One picture per cell, 00000.exr and so on, and index.csv with their coordinates; how many pictures.

    EXR holds the values as they are (float). PNG has 16 bits, linear, its largest value white; `peak` in the index is what
    white stands for. The index names for each axis the middle of the cell and its two ends; it is written last.
    """
    folder = Path(folder)
    if suffix not in ("exr", "png"):
        raise InputError(f"kernels are exported as exr or png, got {suffix!r}")
    if folder.exists() and not (folder.is_dir() and (overwrite or not any(folder.iterdir()))):
        raise InputError(f"{folder} exists already: give another name, or --overwrite to write into it")
    rows = []
    for cell, kernel in track(list(enumerate(bank.kernels)), "kernels"):
        peak = float(kernel.max())
        rgb = np.broadcast_to(kernel if suffix == "exr" else kernel / peak, (*kernel.shape[:2], 3))
        name = f"{cell:05d}.{suffix}"
        write_image(folder / name, np.ascontiguousarray(rgb), "linear", half=False)
        places = [value for centre, ends in zip(bank.centres[cell], bank.boxes[cell], strict=True) for value in (centre, *ends)]
        rows.append([name, kernel.shape[0], f"{peak:.9g}", *(f"{value:.9g}" for value in places)])
    titles = [title for axis in bank.axes for title in (axis.name, f"{axis.name}_low", f"{axis.name}_high")]
    with atomic_path(folder / "index.csv") as temporary, temporary.open("w", newline="", encoding="utf-8") as file:
        csv.writer(file).writerows([["file", "size_px", "peak", *titles], *rows])
    return len(rows)
