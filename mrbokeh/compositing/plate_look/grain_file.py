"""Grain as a JSON file, so that one measurement serves all frames of a camera and setting."""

from pathlib import Path
from typing import Any

import numpy as np

from mrbokeh.compositing.plate_look.colour_match import Triple, triple_of
from mrbokeh.compositing.plate_look.grain import Grain
from mrbokeh.compositing.plate_look.noise_correlation import LAGS
from mrbokeh.compositing.plate_look.noise_level import NoiseLevel
from mrbokeh.system.atomic_files import read_json, write_json
from mrbokeh.system.errors import InputError

FORMAT, VERSION = "mrbokeh-grain", 1


def write_grain(path: Path | str, grain: Grain) -> None:
    document = {"format": FORMAT, "version": VERSION, "shot": grain.level.shot, "read": grain.level.read, "seed": grain.seed}
    write_json(path, document | {"correlation": np.round(grain.correlation, 6).tolist()})


def read_grain(path: Path | str) -> Grain:
    """Raises InputError where the file is not a grain file."""
    document = read_json(path, "a grain file")
    if not isinstance(document, dict) or document.get("format") != FORMAT or document.get("version") != VERSION:
        raise InputError(f'{path}: expected a grain file with "format": "{FORMAT}" and "version": {VERSION}: measure the grain again')
    level = NoiseLevel(_three(document, "shot", path), _three(document, "read", path))
    seed = document.get("seed", 0)
    if not isinstance(seed, int) or seed < 0:
        raise InputError(f"{path}: expected seed as a whole number not below 0, got {seed!r}")
    return Grain(level, _numbers(document, "correlation", (LAGS, LAGS, 3, 3), path), seed)


def _three(document: dict[str, Any], key: str, path: Path | str) -> Triple:
    return triple_of(_numbers(document, key, (3,), path))


def _numbers(document: dict[str, Any], key: str, shape: tuple[int, ...], path: Path | str) -> np.ndarray:
    try:
        values = np.array(document.get(key), np.float64)
    except (TypeError, ValueError):
        values = np.zeros(0)
    if values.shape != shape or not np.isfinite(values).all():
        raise InputError(f"{path}: expected {key} as numbers of shape {shape}, got something else: measure the grain again")
    return values
