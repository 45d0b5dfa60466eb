"""What the size of the discs tells: the focus distance, the effective f-number, where the lights are, or a bound of these."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64

from mrbokeh.lens_measuring.matching.focus_from_size import depth_from_size, effective_f_number, focus_from_size
from mrbokeh.lens_measuring.matching.photo_facts import PhotoFacts
from mrbokeh.optics.lens import Lens
from mrbokeh.system.errors import InputError

EDGE_PX, FULL_EDGE_PX = 0.15, 0.6
"""By how much diameters are off all alike. Where light L is clipped at 1, the contour at one half lies where a pixel is covered by
0.5 / L: up to half a pixel too far out on each side, on average over all L a quarter."""


@dataclass(frozen=True)
class Sizes:
    """f_number and focus_distance_m: for the lens file. Errors: standard, None where the value is as stated or unknown.

    focus_known: False where focus_distance_m only stands for the lights being far off. note: what was made of the sizes, for people.
    """

    f_number: float
    f_number_error: float | None
    stated_f_number: float
    focus_distance_m: float
    focus_error_m: float | None
    focus_known: bool
    diameter_px: float
    diameter_error_px: float
    note: str


def size_facts(
    facts: PhotoFacts,
    diameters_px: Float64[np.ndarray, " discs"],
    side: int,
    depth_m: float | None,
    image_width_px: int,
    full: bool = False,
) -> Sizes:
    """diameters_px: of the unit pupil. depth_m: of the lights. facts: all but the focus distance must be there.

    full: whether the light of most discs is beyond what the file can hold.
    """
    if depth_m is not None and not depth_m > 0.0:
        raise InputError(f"expected --depth-m above 0 (inf is allowed), got {depth_m:g}")
    facts.require("the photograph")
    diameter = float(np.median(diameters_px))
    error = float(np.hypot(1.2533 * diameters_px.std() / np.sqrt(len(diameters_px)), FULL_EDGE_PX if full else EDGE_PX))
    stated = Lens(
        float(facts.focal_length_mm or 0.0),
        float(facts.f_number or 0.0),
        facts.focus_distance_m or np.inf,
        float(facts.sensor_width_mm or 0.0),
    )

    def made(f_number: float, f_error: float | None, focus_m: float, focus_error_m: float | None, known: bool, note: str) -> Sizes:
        return Sizes(f_number, f_error, stated.f_number, focus_m, focus_error_m, known, diameter, error, note)

    if facts.focus_distance_m is not None and depth_m is not None:
        f_number, f_error = _with_error(lambda size: effective_f_number(stated, side * size, depth_m, image_width_px), diameter, error)
        return made(f_number, f_error, facts.focus_distance_m, None, True, f"effective f-number from lights at {depth_m:g} m")
    if depth_m is not None:
        focus_m, focus_error = _with_error(lambda size: focus_from_size(stated, side * size, depth_m, image_width_px), diameter, error)
        return made(stated.f_number, None, focus_m, focus_error, True, f"focus from lights at {depth_m:g} m and the stated f-number")
    if facts.focus_distance_m is not None:
        return made(stated.f_number, None, facts.focus_distance_m, None, True, _lights_at(stated, side * diameter, image_width_px))
    far_m = focus_from_size(stated, diameter, np.inf, image_width_px) if side > 0 else np.inf
    bound = f"at most {far_m:.3g} m, which the lens file holds (lights far away)" if side > 0 else "the lens file holds infinity"
    return made(stated.f_number, None, far_m, None, False, f"focus unknown, {bound}: give --depth-m or --focus")


def _with_error(value: Callable[[float], float], at: float, error: float) -> tuple[float, float]:
    """By the slope over a thousandth, times the standard error."""
    here, step = value(at), 1e-3 * at
    return here, abs(value(at - step) - here) / step * error if np.isfinite(here) else 0.0


def _lights_at(lens: Lens, coc_px: float, image_width_px: int) -> str:
    """Where the lights are by the stated f-number, or how far it is off where they would have to be beyond infinity."""
    depth_m = depth_from_size(lens, coc_px, image_width_px)
    if depth_m > 0.0:
        return f"the stated f-number has the lights at {depth_m:.3g} m; give --depth-m for the effective one"
    largest_px = float(lens.coc_px(np.inf, image_width_px))
    return (
        f"discs are larger than f/{lens.f_number:g} makes them even far away: the effective f-number is at most "
        f"{lens.f_number * largest_px / coc_px:.3g}; give --depth-m"
    )
