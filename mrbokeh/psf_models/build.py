"""A model becomes a bank in a folder, cell by cell; an interrupted build goes on where it stopped."""

import json
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
from jaxtyping import Float64

from mrbokeh.optics.psf_bank import PsfBank, check_kernel, physical_boxes
from mrbokeh.optics.psf_bank_file import (
    HEAD,
    BankHead,
    clear_bank,
    missing_cells,
    read_bank,
    read_head,
    refuse_existing_bank,
    write_cell,
    write_head,
)
from mrbokeh.psf_models.base import PsfModel
from mrbokeh.system.console import track
from mrbokeh.system.errors import InputError
from mrbokeh.system.workers import cores


def bank_head(model: PsfModel, rays: int, seed: int) -> BankHead:
    """The description of a model's bank. Several coordinates make a nested grid, unless the model has a knee for a proportional one.

    One coordinate keeps the regular grid after its power remapping: nesting saves cells only where coordinates multiply, and
    100 cells up to 512 px (exponent 2) are then 10 px wide at the far end instead of 20. Signed diameters must not be nested.
    """
    nested = model.knee_px is None and len(model.axes) > 1 and not any(axis.is_signed for axis in model.axes)
    settings = json.loads(json.dumps({**model.settings, "rays": rays, "seed": seed}))
    facts = (model.axes, model.counts, nested, model.turns, model.near_side_turned, settings, model.knee_px)
    return BankHead(model.name, model.channels, *facts)


def build_bank(
    model: PsfModel,
    folder: Path | str,
    rays: int | None = None,
    seed: int = 0,
    progress: bool = True,
    overwrite: bool = False,
    threads: int = 0,
) -> PsfBank:
    """Build (or go on building) a bank and read it.

    rays: per kernel; None is what suits the model, 0 its closed form. Cell i is traced with the seed `seed` + i, so that it
    is the same whoever traces it, when and beside how many others. threads: 0 takes all cores (on the
    device 'cpu' one, as torch shares out each kernel itself).
    A folder that holds a part of the very same bank is completed; a finished bank, another one, or other files are an
    InputError unless `overwrite` (which only ever removes a bank).
    """
    rays = model.default_rays if rays is None else rays
    if rays < 0:
        raise InputError(f"a number of rays is 0 (closed form) or positive, got {rays}")
    if model.device and not rays:
        raise InputError(f"the closed form of {model.name} is not traced, so it has no use for the device {model.device!r}: give rays too")
    head = bank_head(model, rays, seed)
    boxes = physical_boxes(head.axes, head.grid)
    if overwrite or not _is_part_of(folder, head):
        refuse_existing_bank(folder, overwrite)
        first = model.kernel(boxes[0], rays, seed)  # before anything is written: what is wrong with a model shows here
        check_kernel(first, f"the first kernel of {model.name}")
        clear_bank(folder)
        write_head(folder, head)
        write_cell(folder, 0, first)

    threads = threads or (1 if model.device.startswith("cpu") else cores())
    with ThreadPoolExecutor(threads) as pool:
        building = [pool.submit(_build_cell, model, folder, cell, boxes[cell], rays, seed) for cell in missing_cells(folder, head)]
        try:
            for future in track(building, f"kernels of {model.name}") if progress else building:
                future.result()
        except BaseException:
            pool.shutdown(cancel_futures=True)
            raise
    return read_bank(folder)


def _build_cell(model: PsfModel, folder: Path | str, cell: int, box: Float64[np.ndarray, "axes 2"], rays: int, seed: int) -> None:
    write_cell(folder, cell, model.kernel(box, rays, seed + cell))


def _is_part_of(folder: Path | str, head: BankHead) -> bool:
    """Whether a folder holds some but not all cells of this very bank."""
    return (Path(folder) / HEAD).is_file() and read_head(folder) == head and bool(missing_cells(folder, head))
