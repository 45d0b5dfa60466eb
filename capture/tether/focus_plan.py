"""Focus distances for a bracket in which everything between two distances is sharp in at least one slice.

Blur is linear in dioptres, so the slices are equally spaced in dioptres. Halfway between two slices the circle of confusion is,
in a picture w_i pixels wide of a sensor w_s wide,

    c = (w_i / w_s) a d_s step / 2,    a = f / N,    d_s = f d_f / (d_f - f)

(Mandl et al. 2024, Eq. 1, in dioptres). The image distance d_s is longest at the nearest focus, so that slice bounds all of
them. The bound is tight: the nearest slice has the narrowest view and gives the merged picture its scale, and in pixels of that
scale every gap has the same residual.

A plan is written as plan.json, as plan.csv for people who turn the ring by hand, and as a table in the terminal:

    {"format": "mrbokeh-focus-plan", "version": 1, "lens": {...}, "image_width_px": 6000, "near_m": 0.5, "far_m": null,
     "wanted_residual_px": 1.0, "residual_px": 0.98, "largest_coc_px": 105.2,
     "slices": [{"dioptre": 2.0, "focus_distance_m": 0.5, "film_plane_m": 0.538, "breathing": 1.0}, ...]}

Only the lens, the width, the range and the dioptres are read back; everything else follows from them. null is infinity.
"""

import csv
import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

from rich.table import Table

from mrbokeh.optics.lens import MM_PER_M, Lens, film_plane_m, lens_distance_m
from mrbokeh.optics.lens_file import lens_from_json, lens_to_json
from mrbokeh.system.atomic_files import atomic_path, read_json, write_json
from mrbokeh.system.errors import InputError
from mrbokeh.system.messages import show, tell, warn

MOST_SLICES = 999
_ROUNDING = 1e-9
FORMAT = "mrbokeh-focus-plan"
VERSION = 1
_ROUNDING_PX = 1e-6


@dataclass(frozen=True)
class FocusRange:
    """Distances that must be sharp, in metres from the lens; far_m may be inf."""

    near_m: float
    far_m: float

    def __post_init__(self) -> None:
        if not 0.0 < self.near_m <= self.far_m or math.isinf(self.near_m):
            raise InputError(f"expected a near distance above 0 that is not beyond the far one, got {self.near_m:g} m and {self.far_m:g} m")

    @property
    def dioptres(self) -> float:
        return 1.0 / self.near_m - 1.0 / self.far_m

    @classmethod
    def from_film_plane(cls, near_m: float, far_m: float, focal_length_mm: float) -> "FocusRange":
        """Convert distances measured from the film plane, where cameras have their mark."""
        near, far = (lens_distance_m(each, focal_length_mm) for each in (near_m, far_m))
        if near is None or far is None:
            raise InputError(
                f"a thin lens of {focal_length_mm:g} mm has its focus at least {4 * focal_length_mm / MM_PER_M:g} m from the film plane, "
                f"got {near_m:g} m"
            )
        return cls(near, far)


@dataclass(frozen=True)
class FocusPlan:
    """The slices of a bracket, nearest first.

    lens: focused anywhere. image_width_px: of the whole sensor picture. dioptres: 1 / focus distance from the lens, falling.
    wanted_residual_px: the requested diameter; `residual_px` is what the slices give.
    """

    lens: Lens
    image_width_px: int
    range: FocusRange
    dioptres: tuple[float, ...]
    wanted_residual_px: float = 1.0

    def __post_init__(self) -> None:
        falling = all(near > far for near, far in zip(self.dioptres, self.dioptres[1:], strict=False))
        if not self.dioptres or not falling or self.dioptres[-1] < 0.0:
            raise InputError(f"a focus plan needs falling dioptres of at least 0, got {list(self.dioptres)}")

    def __len__(self) -> int:
        return len(self.dioptres)

    @cached_property
    def lenses(self) -> tuple[Lens, ...]:
        """Return the lens focused for each slice."""
        return tuple(self.lens.focused_at(1.0 / each if each > 0.0 else math.inf) for each in self.dioptres)

    @property
    def px_per_dioptre(self) -> float:
        """Return the diameter per dioptre in the nearest slice, where it is largest."""
        return self.lenses[0].coc_px_per_dioptre(self.image_width_px)

    @property
    def residual_px(self) -> float:
        """Return the largest blur within the range in the slice that shows it sharpest, in pixels of the nearest slice."""
        ends = (1.0 / self.range.near_m - self.dioptres[0], self.dioptres[-1] - 1.0 / self.range.far_m)
        gaps = (near - far for near, far in zip(self.dioptres, self.dioptres[1:], strict=False))
        return self.px_per_dioptre * max(*ends, *(gap / 2.0 for gap in gaps), 0.0)

    @property
    def largest_coc_px(self) -> float:
        """Return the largest blur of anything within the range in any slice; a network has to cover it."""
        within = (1.0 / self.range.near_m, 1.0 / self.range.far_m)
        return max(
            lens.coc_px_per_dioptre(self.image_width_px) * abs(focus - seen)
            for lens, focus in zip(self.lenses, self.dioptres, strict=True)
            for seen in within
        )

    @property
    def breathing(self) -> tuple[float, ...]:
        """Return the size of the picture in each slice over that in the nearest one: the ratio of their image distances d_s."""
        return tuple(lens.image_distance_mm / self.lenses[0].image_distance_mm for lens in self.lenses)


def plan_focus(lens: Lens, focus_range: FocusRange, image_width_px: int, residual_px: float = 1.0) -> FocusPlan:
    """Plan the fewest slices that keep the residual circle of confusion at residual_px (a diameter), from near to far."""
    step = _step_dioptres(lens, focus_range, image_width_px, residual_px)
    gaps = math.ceil(focus_range.dioptres / step - _ROUNDING)
    _require_feasible(gaps + 1, residual_px)
    near, far = 1.0 / focus_range.near_m, 1.0 / focus_range.far_m
    dioptres = (*(near + (far - near) * index / gaps for index in range(gaps)), far)
    return FocusPlan(lens=lens, image_width_px=image_width_px, range=focus_range, dioptres=dioptres, wanted_residual_px=residual_px)


def plan_for_motor(
    lens: Lens, focus_range: FocusRange, image_width_px: int, residual_px: float, *, motor_step_dioptres: float
) -> FocusPlan:
    """Plan slices that are a whole number of motor steps apart, so that a motor that only counts can reach them."""
    if not motor_step_dioptres > 0.0:
        raise InputError(f"a motor step must be a positive number of dioptres, got {motor_step_dioptres:g}")
    step = _step_dioptres(lens, focus_range, image_width_px, residual_px)
    step = max(1, math.floor(step / motor_step_dioptres + _ROUNDING)) * motor_step_dioptres
    gaps = math.ceil(focus_range.dioptres / step - _ROUNDING)
    _require_feasible(gaps + 1, residual_px)
    # No lens focuses beyond infinity, hence the last gap may be shorter.
    dioptres = tuple(max(1.0 / focus_range.near_m - step * index, 0.0) for index in range(gaps + 1))
    return FocusPlan(lens=lens, image_width_px=image_width_px, range=focus_range, dioptres=dioptres, wanted_residual_px=residual_px)


def on_scale(plan: FocusPlan, marks_m: Sequence[float]) -> FocusPlan:
    """Move every slice to the nearest mark (in dioptres) of a distance scale; marks in metres from the lens, no mark twice.

    A scale with few marks leaves larger gaps; see `residual_px` of the result.
    """
    if not marks_m or not all(each > 0.0 for each in marks_m):
        raise InputError(f"expected a distance scale of positive metres, got {list(marks_m)}")
    marks = [1.0 / each for each in marks_m]
    chosen = {min(marks, key=lambda mark: abs(mark - wanted)) for wanted in plan.dioptres}
    return FocusPlan(
        lens=plan.lens,
        image_width_px=plan.image_width_px,
        range=plan.range,
        dioptres=tuple(sorted(chosen, reverse=True)),
        wanted_residual_px=plan.wanted_residual_px,
    )


def _step_dioptres(lens: Lens, focus_range: FocusRange, image_width_px: int, residual_px: float) -> float:
    if not residual_px > 0.0 or not image_width_px > 0:
        raise InputError(f"expected a positive residual and picture width, got {residual_px:g} px and {image_width_px} px")
    return 2.0 * residual_px / lens.focused_at(focus_range.near_m).coc_px_per_dioptre(image_width_px)


def _require_feasible(slices: int, residual_px: float) -> None:
    if slices > MOST_SLICES:
        raise InputError(
            f"{slices} slices would be needed for a residual of {residual_px:g} px: allow a larger one, a shorter range, "
            f"a larger f-number, or plan for a smaller picture"
        )


def plan_to_json(plan: FocusPlan) -> dict[str, Any]:
    return {
        "format": FORMAT,
        "version": VERSION,
        "lens": lens_to_json(plan.lenses[0]),
        "image_width_px": plan.image_width_px,
        "near_m": plan.range.near_m,
        "far_m": _finite(plan.range.far_m),
        "wanted_residual_px": plan.wanted_residual_px,
        "residual_px": plan.residual_px,
        "largest_coc_px": plan.largest_coc_px,
        "slices": [_slice_row(plan, index) for index in range(len(plan))],
    }


def plan_from_json(document: Any, where: str = "focus plan") -> FocusPlan:
    """Read the plan from a document as in the head of this module. Raises InputError for other documents."""
    if not isinstance(document, dict) or (document.get("format"), document.get("version")) != (FORMAT, VERSION):
        raise InputError(f"{where}: expected a focus plan of version {VERSION}; write one with `mrbokeh capture plan --out plan.json`")
    try:
        far_m = math.inf if document["far_m"] is None else float(document["far_m"])
        return FocusPlan(
            lens=lens_from_json(document["lens"], where),
            image_width_px=int(document["image_width_px"]),
            range=FocusRange(float(document["near_m"]), far_m),
            dioptres=tuple(float(each["dioptre"]) for each in document["slices"]),
            wanted_residual_px=float(document["wanted_residual_px"]),
        )
    except (KeyError, TypeError, ValueError) as error:
        raise error if isinstance(error, InputError) else InputError(f"{where}: this focus plan is damaged ({error!r})") from None


def read_plan(path: Path) -> FocusPlan:
    return plan_from_json(read_json(path, "a focus plan (plan.json)"), str(path))


def write_plan(path: Path, plan: FocusPlan) -> None:
    write_json(path, plan_to_json(plan))


def write_plan_table(path: Path, plan: FocusPlan) -> None:
    """Write plan.csv: one row for each slice, distances in metres, inf for infinity."""
    rows = [{"slice": index} | _table_row(plan, index) for index in range(len(plan))]
    with atomic_path(path) as temporary, temporary.open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, list(rows[0]))
        writer.writeheader()
        writer.writerows(rows)


def _table_row(plan: FocusPlan, index: int) -> dict[str, str]:
    lens = plan.lenses[index]
    return {
        "from_lens_m": f"{lens.focus_distance_m:.4f}",
        "from_film_plane_m": f"{film_plane_m(lens):.4f}",
        "dioptre": f"{plan.dioptres[index]:.4f}",
        "breathing": f"{plan.breathing[index]:.5f}",
    }


def _slice_row(plan: FocusPlan, index: int) -> dict[str, float | None]:
    lens = plan.lenses[index]
    return {
        "dioptre": plan.dioptres[index],
        "focus_distance_m": _finite(lens.focus_distance_m),
        "film_plane_m": _finite(film_plane_m(lens)),
        "breathing": plan.breathing[index],
    }


def _finite(value: float) -> float | None:
    return None if math.isinf(value) else value


def print_plan(plan: FocusPlan) -> None:
    """Print the focus distances from the lens and from the film plane, and the blur that the plan leaves."""
    table = Table("slice", "from lens (m)", "from film plane (m)", "dioptres", "breathing")
    for index, lens in enumerate(plan.lenses):
        numbers = lens.focus_distance_m, film_plane_m(lens), plan.dioptres[index], plan.breathing[index]
        table.add_row(str(index), *(f"{each:.4f}" for each in numbers))
    show(table, slices=[_slice_row(plan, index) for index in range(len(plan))], residual_px=plan.residual_px)
    count = "1 slice" if len(plan) == 1 else f"{len(plan)} slices"
    tell(f"{count} of {plan.image_width_px} px, largest residual circle of confusion {plan.residual_px:.2f} px")
    tell(f"largest circle of confusion within the range: {plan.largest_coc_px:.1f} px (what a network has to reach)")
    if plan.residual_px > plan.wanted_residual_px + _ROUNDING_PX:
        warn(f"the residual is above the {plan.wanted_residual_px:g} px that were asked for: the steps are too coarse")
