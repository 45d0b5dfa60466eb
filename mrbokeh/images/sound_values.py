"""Refusing pictures whose numbers cannot be meant."""

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from mrbokeh.system.errors import InputError


def require_numbers(path: Path | str, planes: Mapping[str, np.ndarray]) -> None:
    """Raises InputError where values are NaN; planes by what they hold."""
    for what, values in planes.items():
        if broken := int(np.isnan(values).sum()):
            raise InputError(f"{path}: {what} is NaN in {broken} place{'' if broken == 1 else 's'}: mend the render first")


def require_depth_ahead(path: Path | str, name: str, stored: np.ndarray) -> None:
    """Raises InputError where depth is negative and nowhere positive, as programs write it whose cameras look along -z.

    stored: of what is seen. 0 everywhere is fine: all is background.
    """
    if (stored < 0).any() and not (stored > 0).any():
        raise InputError(
            f"{path}: {name} is negative ({float(stored.min()):g} to {float(stored.max()):g}): expected distances ahead of the camera "
            f"as positive numbers, so turn the sign"
        )
