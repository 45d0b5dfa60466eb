"""The spreadlets of a whole bank, cell by cell, kept beside it; an interrupted build goes on where it stopped."""

from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np

from mrbokeh.optics.psf_bank_file import SPREADLETS, SPREADLETS_PART, read_bank
from mrbokeh.renderers.kernels.spreadlets import Sparsification, Spreadlet, Spreadlets, sparsify
from mrbokeh.renderers.kernels.spreadlets_file import fingerprint, read_spreadlets, write_spreadlets
from mrbokeh.system.console import track
from mrbokeh.system.errors import InputError
from mrbokeh.system.resources import cores


def build_spreadlets(
    folder: Path | str, settings: Sparsification, overwrite: bool = False, progress: bool = True, threads: int = 0
) -> Spreadlets:
    """Write BANK/spreadlets.npz and return what is in it.

    Cells wait in BANK/spreadlets.part until all are there; one that is of this very kernel and made in this very way is not
    computed again. A finished file of the same kernels and settings is an InputError unless `overwrite`; one of other kernels
    or settings is replaced. threads: 0 takes all cores; they change nothing in the result.
    """
    folder, bank = Path(folder), read_bank(folder)
    whole = fingerprint(bank.kernels)
    if not overwrite and read_spreadlets(folder / SPREADLETS, settings, whole) is not None:
        raise InputError(f"{folder / SPREADLETS} is there already and of these kernels: give --overwrite to compute it again")

    with ThreadPoolExecutor(threads or cores()) as pool:
        cells = [pool.submit(_of_cell, _part(folder, cell), kernel, settings) for cell, kernel in enumerate(bank.kernels)]
        try:
            made = [future.result() for future in (track(cells, "spreadlets") if progress else cells)]
        except BaseException:
            pool.shutdown(cancel_futures=True)
            raise
    spreadlets = Spreadlets.joined(made)
    write_spreadlets(folder / SPREADLETS, spreadlets, settings, whole)
    for cell in range(len(made)):
        _part(folder, cell).unlink(missing_ok=True)
    (folder / SPREADLETS_PART).rmdir()
    return spreadlets


def _part(folder: Path, cell: int) -> Path:
    return folder / SPREADLETS_PART / f"{cell:05d}.npz"


def _of_cell(path: Path, kernel: np.ndarray, settings: Sparsification) -> Spreadlet:
    """The spreadlet of one kernel, from its file where that is of this kernel and these settings."""
    of = fingerprint((kernel,))
    kept = read_spreadlets(path, settings, of)
    if kept is not None:
        return kept[0]
    made = sparsify(kernel, settings)
    write_spreadlets(path, Spreadlets.joined([made]), settings, of)
    return made
