"""Ways of putting layers into a photograph, by name."""

from mrbokeh.compositing.base import Insertion
from mrbokeh.compositing.between import Between
from mrbokeh.compositing.matte import SmoothedMatte
from mrbokeh.compositing.over import OverPhotograph
from mrbokeh.compositing.rerender import Rerendered
from mrbokeh.compositing.touched_box import InTouchedBox
from mrbokeh.system.errors import InputError

MODES: dict[str, Insertion] = {
    "front": InTouchedBox(OverPhotograph(by_depth=False)),
    "over": InTouchedBox(OverPhotograph()),
    "matte": InTouchedBox(SmoothedMatte()),
    "between": InTouchedBox(Between()),
    "rerender": InTouchedBox(Rerendered()),
}
"""front: over everything. over: the sharp layers lose what the depth of the photograph hides, then they are blurred. matte: the same
with the paper's smoothed matte. between: behind the blurred near things of the photograph, before the rest. rerender: all-in-focus
picture and layers blurred together."""

DEFAULT_MODE = "over"


def insertion_of(mode: str, near_m: float | None = None, *, exact_depth: bool = False) -> Insertion:
    """near_m: how far what a user's matte shows is, for the mode between. exact_depth: rims stay where the depth has them.

    Raises InputError where there is no mode of that name.
    """
    if mode not in MODES:
        raise InputError(f"expected a mode out of {', '.join(MODES)}, got {mode!r}")
    if near_m is not None and mode != "between":
        raise InputError(f"the distance of what the matte shows is for the mode between, got the mode {mode}: leave it out")
    if mode == "between":
        return InTouchedBox(Between(near_depth_m=near_m, true_rims=not exact_depth))
    return InTouchedBox(Rerendered(true_rims=not exact_depth)) if mode == "rerender" else MODES[mode]
