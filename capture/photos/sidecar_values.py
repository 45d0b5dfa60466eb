"""The values of a lens.toml in their types, or a sentence that says what is wrong with one."""

import math
from pathlib import Path
from typing import Any

from capture.photos.stated_focus import StatedFocus
from mrbokeh.system.errors import InputError

_ORIGINS = ("lens", "film_plane")


def checked(key: str, value: Any, path: Path) -> Any:
    """One value in its type, or InputError."""
    if key == "focus_origin":
        if value not in _ORIGINS:
            raise InputError(f"{path}: focus_origin must be one of {', '.join(_ORIGINS)}, got {value!r}")
        return value
    if key == "blades":
        if not isinstance(value, int) or isinstance(value, bool) or value < 3:
            raise InputError(f"{path}: blades must be a whole number of at least 3, got {value!r}")
        return value
    if key == "focus_distances_m":
        if isinstance(value, dict):
            return {name: _stated(each, f"{path}: {key}.{name}") for name, each in value.items()}
        if isinstance(value, list):
            return tuple(_stated(each, f"{path}: {key}") for each in value)
        raise InputError(f"{path}: focus_distances_m must be a list of metres or a table of file names, got {value!r}")
    if key == "blade_rotation_rad":
        return _number(key, value, path)
    if key == "hiatus_mm":
        return _number(key, value, path)
    if key == "obstruction":
        share = _number(key, value, path)
        if not 0.0 <= share < 1.0:
            raise InputError(f"{path}: obstruction must be from 0 to below 1, got {value!r}")
        return share
    return _positive(key, value, path)


def _stated(value: Any, where: str) -> StatedFocus:
    return StatedFocus.checked(value if isinstance(value, list) and value else [value], where)


def _number(key: str, value: Any, path: Path) -> float:
    if isinstance(value, bool) or not isinstance(value, (int, float)) or math.isnan(value):
        raise InputError(f"{path}: {key} must be a number, got {value!r}")
    return float(value)


def _positive(key: str, value: Any, path: Path) -> float:
    result = _number(key, value, path)
    if result <= 0 or math.isinf(result):
        raise InputError(f"{path}: {key} must be positive, got {value!r}")
    return result
