"""Files beside a bank of what methods make of its kernels: BANK/spreadlets.npz, BANK/polygons.npz (apertures), BANK/low_rank.npz (terms).

A file is used only if it is of the same kernels, over the same coordinates, made in the same way. Polygons and terms are made anew
otherwise; spreadlets take minutes and are built by `mrbokeh lens spreadlets`, cell by cell, so that an interrupted build goes on
where it stopped.
"""

import json
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from dataclasses import asdict
from hashlib import sha256
from itertools import chain
from pathlib import Path
from zipfile import BadZipFile

import numpy as np
from jaxtyping import Float64

from mrbokeh.optics.aperture import Aperture
from mrbokeh.optics.psf_bank_file import LOW_RANK, POLYGONS, SPREADLETS, SPREADLETS_PART, read_bank
from mrbokeh.renderers.bank.apertures import LEVELS, BankApertures, fit_apertures
from mrbokeh.renderers.bank.lattice import BankLattice
from mrbokeh.renderers.bank.renderers import BankTerms, decompose_bank
from mrbokeh.renderers.kernels.low_rank_kernel import LowRankKernel
from mrbokeh.renderers.kernels.spreadlets import Sparsification, Spreadlet, Spreadlets, sparsify
from mrbokeh.system.atomic_files import atomic_path
from mrbokeh.system.console import track
from mrbokeh.system.errors import InputError
from mrbokeh.system.resources import cores

_SPREADLETS_VERSION = 1


def write_spreadlets(path: Path | str, spreadlets: Spreadlets, made_by: Sparsification, of: str) -> None:
    """Write one .npz: points (N, 2) int16, values (N, C) float64, starts (cells + 1,), and what they were made of and how.

    of: a fingerprint of the kernels (`fingerprint`).
    """
    facts = json.dumps({"version": _SPREADLETS_VERSION, "sparsification": asdict(made_by), "of": of})
    with atomic_path(path) as temporary:
        np.savez(temporary, points=spreadlets.points, values=spreadlets.values, starts=spreadlets.starts, facts=np.array(facts))


def read_spreadlets(path: Path | str, made_by: Sparsification, of: str) -> Spreadlets | None:
    """Return the spreadlets in a file; None if there is no such file or they are of other kernels or made in another way."""
    found = _read_spreadlets(path)
    return found[0] if found is not None and found[1:] == (asdict(made_by), of) else None


def spreadlets_beside(folder: Path | str, kernels: tuple[np.ndarray, ...]) -> Spreadlets | None:
    """Return the spreadlets that `mrbokeh lens spreadlets` has put beside a bank, however they were made; None if there are none.

    InputError if they are not of these kernels: the bank was changed after.
    """
    path = Path(folder) / "spreadlets.npz"
    found = _read_spreadlets(path)
    if found is not None and found[2] != fingerprint(kernels):
        raise InputError(f"{path} is of other kernels than the bank has now: run `mrbokeh lens spreadlets {folder}` again, or remove it")
    return None if found is None else found[0]


def _read_spreadlets(path: Path | str) -> tuple[Spreadlets, dict, str] | None:
    """Read spreadlets, their settings and the fingerprint of their kernels; None if there is no such file or it is of another version."""
    if not Path(path).exists():
        return None
    try:
        with np.load(path) as file:
            facts = json.loads(str(file["facts"]))
            if facts["version"] != _SPREADLETS_VERSION:
                return None
            return Spreadlets(file["points"], file["values"], file["starts"]), facts["sparsification"], facts["of"]
    except (BadZipFile, EOFError, KeyError, TypeError, ValueError, OSError) as error:
        raise InputError(f"{path} is not a file of spreadlets ({error}): remove it, it will be computed again") from None


def fingerprint(kernels: tuple[np.ndarray, ...]) -> str:
    """Return a hash, the same for the same kernels."""
    from hashlib import sha256

    digest = sha256()
    for kernel in kernels:
        digest.update(str(kernel.shape).encode())
        digest.update(np.ascontiguousarray(kernel).tobytes())
    return digest.hexdigest()[:32]


_VERSION = 3

Arrays = dict[str, np.ndarray]


def apertures_beside(folder: Path | str, lattice: BankLattice, levels: int = LEVELS) -> BankApertures:
    """Return the polygons beside a bank, fitted and written there if they are not there yet (where the folder may be written to)."""
    path, key = Path(folder) / POLYGONS, _key(lattice, ["polygons", levels])
    found = _read(path, key)
    if found is None:
        made = fit_apertures(lattice, levels)
        _write(path, _apertures_to_arrays(made), key)
        return made
    return _apertures_from(found, lattice)


def terms_beside(
    folder: Path | str,
    lattice: BankLattice,
    decomposed: Callable[[Float64[np.ndarray, "size size"]], LowRankKernel],
    made_by: Sequence[float | int],
) -> BankTerms:
    """Return the low-rank terms beside a bank, found and written there if they are not there yet. made_by: the settings on which
    `decomposed` depends.

    A bank that turns with the field has none: its kernels are turned first, and decomposed when they are used.
    """
    if lattice.directions > 1:
        return {}
    path, key = Path(folder) / LOW_RANK, _key(lattice, ["low-rank", *made_by])
    found = _read(path, key)
    if found is None:
        made = decompose_bank(lattice, decomposed)
        _write(path, _terms_to_arrays(made), key)
        return made
    return _terms_from(found)


def _key(lattice: BankLattice, made_by: Sequence[float | int | str]) -> str:
    bank = lattice.bank
    space = [[asdict(axis) for axis in bank.axes], bank.counts, bank.nested, bank.turns, bank.near_side_turned, bank.knee_px]
    return sha256(json.dumps([_VERSION, fingerprint(bank.kernels), space, made_by]).encode()).hexdigest()[:32]


def _read(path: Path, key: str) -> Arrays | None:
    """Read arrays; None if there is no such file, or its key is another, or it is damaged."""
    try:
        with np.load(path) as file:
            return dict(file) if str(file["key"]) == key else None
    except (BadZipFile, EOFError, KeyError, ValueError, OSError):
        return None


def _write(path: Path, arrays: Arrays, key: str) -> None:
    """Write arrays, unless the bank's folder is read-only."""
    with suppress(PermissionError), atomic_path(path) as temporary:
        np.savez(temporary, allow_pickle=False, key=np.array(key), **arrays)


def _apertures_to_arrays(made: BankApertures) -> Arrays:
    """Return vertices of all outlines, the ends of each outline and of each aperture's outlines, and the number of each kernel's
    aperture, one side after the other.
    """
    of_kernels = [aperture for side in made.apertures for node in side for place in node for aperture in place]
    each = list({id(aperture): aperture for aperture in of_kernels}.values())
    numbers = {id(aperture): number for number, aperture in enumerate(each)}
    outlines = [outline for aperture in each for outline in aperture.outlines]
    return {
        "vertices": np.concatenate(outlines),
        "outline_ends": np.cumsum([len(outline) for outline in outlines]),
        "weights": np.array(list(chain.from_iterable(aperture.weights for aperture in each))),
        "aperture_ends": np.cumsum([len(aperture.outlines) for aperture in each]),
        "of_kernels": np.array([numbers[id(aperture)] for aperture in of_kernels]),
        "diameters_px": np.concatenate(made.diameters_px),
        "behind": np.array(len(made.diameters_px[0])),
        "errors": np.concatenate(made.fit_errors),
    }


def _apertures_from(found: Arrays, lattice: BankLattice) -> BankApertures:
    outlines = np.split(found["vertices"], found["outline_ends"][:-1])
    parts = np.split(np.arange(len(outlines)), found["aperture_ends"][:-1])
    made = [Aperture(tuple(outlines[i] for i in part), tuple(found["weights"][part].tolist())) for part in parts]
    each = iter([made[number] for number in found["of_kernels"]])
    diameters_px = np.split(found["diameters_px"], [int(found["behind"])])
    apertures = tuple(
        tuple(tuple(tuple(next(each) for _ in range(lattice.bank.channels)) for _ in range(lattice.places)) for _ in of_side)
        for of_side in diameters_px
    )
    errors = tuple(np.split(found["errors"], [int(found["behind"])]))
    return BankApertures(tuple(tuple(of_side.tolist()) for of_side in diameters_px), apertures, errors)


def _terms_to_arrays(made: BankTerms) -> Arrays:
    """Return keys (kernels, 4) and the terms of all kernels one after the other; those of a symmetric kernel have no rows."""
    kernels = list(made.values())
    return {
        "keys": np.array(list(made)),
        "ranks": np.array([each.rank for each in kernels]),
        "sizes": np.array([each.columns.shape[1] for each in kernels]),
        "symmetric": np.array([each.is_symmetric for each in kernels]),
        "errors": np.array([each.relative_error for each in kernels]),
        "weights": np.concatenate([each.weights for each in kernels]),
        "columns": np.concatenate([each.columns.ravel() for each in kernels]),
        "rows": np.concatenate([np.zeros(0), *(each.rows.ravel() for each in kernels if each.rows is not None)]),
    }


def _terms_from(found: Arrays) -> BankTerms:
    shapes = list(zip(found["ranks"].tolist(), found["sizes"].tolist(), strict=True))
    areas = np.array([rank * size for rank, size in shapes])
    weights = np.split(found["weights"], np.cumsum(found["ranks"])[:-1])
    columns = np.split(found["columns"], np.cumsum(areas)[:-1])
    rows = np.split(found["rows"], np.cumsum(np.where(found["symmetric"], 0, areas))[:-1])
    return {
        tuple(key): LowRankKernel(weight, column.reshape(shape), None if symmetric else row.reshape(shape), float(error))
        for key, weight, column, row, shape, symmetric, error in zip(
            found["keys"].tolist(), weights, columns, rows, shapes, found["symmetric"], found["errors"], strict=True
        )
    }


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
    """Return the spreadlet of one kernel, from its file if that is of this kernel and these settings."""
    of = fingerprint((kernel,))
    kept = read_spreadlets(path, settings, of)
    if kept is not None:
        return kept[0]
    made = sparsify(kernel, settings)
    write_spreadlets(path, Spreadlets.joined([made]), settings, of)
    return made
