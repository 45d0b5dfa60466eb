"""A bank of PSFs as a folder: bank.json and one array per cell, so that it can be built piece by piece.

    BANK/bank.json          format, version, model, channels, axes, counts, nested, knee_px, turns, near_side_turned, settings
    BANK/cells/00000.npy    (K, K, C) float32, one file per cell in the order of the grid

Distances that are infinite are null. What is computed from the kernels and kept beside them (BANK/spreadlets.npz and, half
built, BANK/spreadlets.part) is removed when the bank is written anew; a kernel that changes otherwise is noticed by its hash.
"""

from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np

from mrbokeh.optics.psf_bank import Axis, Grid, PsfBank, check_kernel, check_space, grid_over
from mrbokeh.system.atomic_files import atomic_path, read_json, refuse_existing, write_json
from mrbokeh.system.errors import InputError
from mrbokeh.system.messages import channel

FORMAT = "mrbokeh-psf-bank"
VERSION = 1
HEAD = "bank.json"
SPREADLETS, SPREADLETS_PART = "spreadlets.npz", "spreadlets.part"
POLYGONS, LOW_RANK = "polygons.npz", "low_rank.npz"


@dataclass(frozen=True)
class BankHead:
    """Description of a bank without its kernels; fields as in `PsfBank`."""

    model: str
    channels: int
    axes: tuple[Axis, ...]
    counts: tuple[int, ...]
    nested: bool
    turns: str
    near_side_turned: bool
    settings: dict[str, Any]
    knee_px: float | None = None

    def __post_init__(self) -> None:
        check_space(self.axes, self.counts, self.nested, self.turns)

    @property
    def grid(self) -> Grid:
        return grid_over(self.axes, self.counts, self.nested, self.knee_px)

    def to_json(self) -> dict[str, Any]:
        axes = [asdict(axis) | {"high": axis.high if np.isfinite(axis.high) else None} for axis in self.axes]
        return {"format": FORMAT, "version": VERSION} | asdict(self) | {"axes": axes, "counts": list(self.counts)}


def head_of(bank: PsfBank) -> BankHead:
    values = {each.name: getattr(bank, each.name) for each in fields(BankHead)}
    return BankHead(**values | {"settings": dict(bank.settings)})


def cell_path(folder: Path | str, cell: int) -> Path:
    return Path(folder) / "cells" / f"{cell:05d}.npy"


def read_head(folder: Path | str) -> BankHead:
    """Read what a bank consists of, whether its cells exist or not."""
    path = Path(folder) / HEAD
    document = read_json(path, "a bank of PSFs (a folder written by `mrbokeh lens psf`)")
    if not isinstance(document, dict) or (document.get("format"), document.get("version")) != (FORMAT, VERSION):
        raise InputError(f"{path}: expected format {FORMAT!r} and version {VERSION}; build the bank again with `mrbokeh lens psf`")
    try:
        values = {key: value for key, value in document.items() if key not in ("format", "version")}
        axes = tuple(Axis(**axis | {"high": np.inf if axis["high"] is None else axis["high"]}) for axis in values.pop("axes"))
        return BankHead(axes=axes, counts=tuple(int(count) for count in values.pop("counts")), **values)
    except (KeyError, TypeError, ValueError) as error:
        raise InputError(f"{path}: not the description of a bank ({error}); build the bank again with `mrbokeh lens psf`") from None


def write_head(folder: Path | str, head: BankHead) -> None:
    write_json(Path(folder) / HEAD, head.to_json())


def write_cell(folder: Path | str, cell: int, kernel: np.ndarray) -> None:
    check_kernel(kernel, f"cell {cell}")
    with atomic_path(cell_path(folder, cell)) as temporary, temporary.open("wb") as file:
        np.save(file, kernel)
    channel().outputs.append(Path(folder))  # once, not cell by cell


def missing_cells(folder: Path | str, head: BankHead) -> list[int]:
    """Return the cells that still have to be built."""
    return [cell for cell in range(len(head.grid)) if not cell_path(folder, cell).is_file()]


def clear_bank(folder: Path | str) -> None:
    """Remove the files of a bank and their caches, and nothing else; the description goes last."""
    folder = Path(folder)
    cells, parts = (folder / "cells").glob("[0-9]*.npy"), (folder / SPREADLETS_PART).glob("[0-9]*.npz")
    for path in [*sorted(cells), *sorted(parts), *(folder / name for name in (SPREADLETS, POLYGONS, LOW_RANK, HEAD))]:
        path.unlink(missing_ok=True)


def refuse_existing_bank(folder: Path | str, overwrite: bool) -> None:
    """Refuse a place that is neither empty nor, with `overwrite`, that of another bank; folders of other things are left alone."""
    folder = Path(folder)
    if folder.exists() and not (folder.is_dir() and (not any(folder.iterdir()) or (folder / HEAD).is_file())):
        raise InputError(f"{folder} exists and is not a bank of PSFs: give another name")
    if (folder / HEAD).is_file():
        refuse_existing(folder, overwrite)


def write_bank(folder: Path | str, bank: PsfBank, overwrite: bool = False) -> None:
    """Write a whole bank at once."""
    refuse_existing_bank(folder, overwrite)
    clear_bank(folder)
    write_head(folder, head_of(bank))
    for cell, kernel in enumerate(bank.kernels):
        write_cell(folder, cell, kernel)


def read_bank(folder: Path | str) -> PsfBank:
    """Read a whole bank. Raises InputError if it is not finished or damaged."""
    head = read_head(folder)
    cells = len(head.grid)
    if missing := len(missing_cells(folder, head)):
        raise InputError(
            f"{folder}: only {cells - missing} of its {cells} kernels are built: run the same `mrbokeh lens psf {head.model} "
            f"--out {folder}` again, it goes on where it stopped"
        )
    kernels = tuple(_read_cell(cell_path(folder, cell), head.channels) for cell in range(cells))
    described = {name: value for name, value in vars(head).items() if name != "channels"}
    return PsfBank(kernels=kernels, **described)


def _read_cell(path: Path, channels: int) -> np.ndarray:
    try:
        kernel = np.load(path, allow_pickle=False)
    except (ValueError, EOFError, OSError) as error:
        raise InputError(f"{path}: not an array ({error}); remove the file and run `mrbokeh lens psf` again") from None
    check_kernel(kernel, str(path))
    if kernel.shape[2] != channels:
        raise InputError(f"{path}: expected {channels} channels, got {kernel.shape[2]}; remove the file and run `mrbokeh lens psf` again")
    return kernel
