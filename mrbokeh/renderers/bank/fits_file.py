"""What renderers make of a bank's kernels, in files beside it: BANK/polygons.npz (fitted apertures) and BANK/low_rank.npz (terms).

A file is used only where it is of the same kernels, over the same coordinates, made in the same way; else it is made anew.
"""

import json
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import asdict
from hashlib import sha256
from itertools import chain
from pathlib import Path
from zipfile import BadZipFile

import numpy as np
from jaxtyping import Float64

from mrbokeh.optics.aperture import Aperture
from mrbokeh.optics.psf_bank_file import LOW_RANK, POLYGONS
from mrbokeh.renderers.bank.apertures import BankApertures, fit_apertures
from mrbokeh.renderers.bank.lattice import BankLattice
from mrbokeh.renderers.bank.low_rank_terms import BankTerms, decompose_bank
from mrbokeh.renderers.kernels.low_rank_kernel import LowRankKernel
from mrbokeh.renderers.kernels.polygon_fit import LEVELS
from mrbokeh.renderers.kernels.spreadlets_file import fingerprint
from mrbokeh.system.atomic_files import atomic_path

_VERSION = 3

Arrays = dict[str, np.ndarray]


def apertures_beside(folder: Path | str, lattice: BankLattice, levels: int = LEVELS) -> BankApertures:
    """The polygons beside a bank, fitted and written there if they are not there yet (where the folder may be written to)."""
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
    """The low-rank terms beside a bank, the same way. made_by: the settings on which `decomposed` depends.

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
    """None where there is no such file, it is of something else, or damaged."""
    try:
        with np.load(path) as file:
            return dict(file) if str(file["key"]) == key else None
    except (BadZipFile, EOFError, KeyError, ValueError, OSError):
        return None


def _write(path: Path, arrays: Arrays, key: str) -> None:
    """Not where the bank's folder is read-only."""
    with suppress(PermissionError), atomic_path(path) as temporary:
        np.savez(temporary, allow_pickle=False, key=np.array(key), **arrays)


def _apertures_to_arrays(made: BankApertures) -> Arrays:
    """vertices of all outlines, where each outline and the outlines of each aperture end; which aperture stands for each kernel, sides
    one after the other.
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
    """keys (kernels, 4); terms of all kernels one after the other, those of a symmetric kernel without rows."""
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
