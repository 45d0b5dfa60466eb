"""Ways of putting layers into a photograph, by name."""

from mrbokeh.compositing.base import Insertion
from mrbokeh.compositing.over import OverPhotograph
from mrbokeh.errors import InputError

MODES: dict[str, Insertion] = {"front": OverPhotograph(by_depth=False), "over": OverPhotograph()}
"""front: over everything. over: the sharp layers lose what the depth of the photograph hides, then they are blurred."""

DEFAULT_MODE = "over"


def insertion_of(mode: str) -> Insertion:
    """Raises InputError where there is no mode of that name."""
    if mode not in MODES:
        raise InputError(f"expected a mode out of {', '.join(MODES)}, got {mode!r}")
    return MODES[mode]
