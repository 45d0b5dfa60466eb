"""Spreadlets in a file: what takes minutes to compute for a bank of kernels is kept beside it (`spreadlets.npz`)."""

import json
from dataclasses import asdict
from pathlib import Path
from zipfile import BadZipFile

import numpy as np

from mrbokeh.renderers.kernels.spreadlets import Sparsification, Spreadlets
from mrbokeh.system.atomic_files import atomic_path
from mrbokeh.system.errors import InputError

_VERSION = 1


def write_spreadlets(path: Path | str, spreadlets: Spreadlets, made_by: Sparsification, of: str) -> None:
    """One .npz: points (N, 2) int16, values (N, C) float64, starts (cells + 1,), and what they were made of and how.

    of: a fingerprint of the kernels (`fingerprint`).
    """
    facts = json.dumps({"version": _VERSION, "sparsification": asdict(made_by), "of": of})
    with atomic_path(path) as temporary:
        np.savez(temporary, points=spreadlets.points, values=spreadlets.values, starts=spreadlets.starts, facts=np.array(facts))


def read_spreadlets(path: Path | str, made_by: Sparsification, of: str) -> Spreadlets | None:
    """The spreadlets in a file; None if there is no such file or they are of other kernels or made in another way."""
    found = _read(path)
    return found[0] if found is not None and found[1:] == (asdict(made_by), of) else None


def spreadlets_beside(folder: Path | str, kernels: tuple[np.ndarray, ...]) -> Spreadlets | None:
    """The spreadlets that `mrbokeh lens spreadlets` has put beside a bank, however they were made; None if there are none.

    InputError if they are not of these kernels: the bank was changed after.
    """
    path = Path(folder) / "spreadlets.npz"
    found = _read(path)
    if found is not None and found[2] != fingerprint(kernels):
        raise InputError(f"{path} is of other kernels than the bank has now: run `mrbokeh lens spreadlets {folder}` again, or remove it")
    return None if found is None else found[0]


def _read(path: Path | str) -> tuple[Spreadlets, dict, str] | None:
    """What is in a file, how it was made and of what; None if there is no such file or it is of another version."""
    if not Path(path).exists():
        return None
    try:
        with np.load(path) as file:
            facts = json.loads(str(file["facts"]))
            if facts["version"] != _VERSION:
                return None
            return Spreadlets(file["points"], file["values"], file["starts"]), facts["sparsification"], facts["of"]
    except (BadZipFile, EOFError, KeyError, TypeError, ValueError, OSError) as error:
        raise InputError(f"{path} is not a file of spreadlets ({error}): remove it, it will be computed again") from None


def fingerprint(kernels: tuple[np.ndarray, ...]) -> str:
    """The same for the same kernels."""
    from hashlib import sha256

    digest = sha256()
    for kernel in kernels:
        digest.update(str(kernel.shape).encode())
        digest.update(np.ascontiguousarray(kernel).tobytes())
    return digest.hexdigest()[:32]
