"""Where to focus, so that everything between two distances is sharp in one slice at least.

Blur is linear in dioptres, so the slices are equally far apart in dioptres. Halfway between two slices the circle of
confusion is, in a picture w_i pixels wide of a sensor w_s wide,

    c = (w_i / w_s) a d_s step / 2,    a = f / N,    d_s = f d_f / (d_f - f)

(Mandl et al. 2024, Eq. 1, in dioptres). The image distance d_s is longest at the nearest focus, so that slice bounds all of
them. The bound is met, not only kept: the nearest slice has the narrowest view and gives the merged picture its scale, and in
pixels of that scale every gap has the same residual.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

from mrbokeh.optics.lens import MM_PER_M, Lens, lens_distance_m
from mrbokeh.system.errors import InputError

MOST_SLICES = 999
_ROUNDING = 1e-9


@dataclass(frozen=True)
class FocusRange:
    """What has to be sharp, in metres from the lens; far_m may be inf."""

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
        """Distances measured from the film plane, where cameras have their mark."""
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
    wanted_residual_px: the diameter that was asked for; `residual_px` is what the slices give.
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
        """The lens as it is focused for each slice."""
        return tuple(self.lens.focused_at(1.0 / each if each > 0.0 else math.inf) for each in self.dioptres)

    @property
    def px_per_dioptre(self) -> float:
        """Of the nearest slice, which is the largest."""
        return self.lenses[0].coc_px_per_dioptre(self.image_width_px)

    @property
    def residual_px(self) -> float:
        """The largest blur within the range in the slice that shows it sharpest, in pixels of the nearest slice."""
        ends = (1.0 / self.range.near_m - self.dioptres[0], self.dioptres[-1] - 1.0 / self.range.far_m)
        gaps = (near - far for near, far in zip(self.dioptres, self.dioptres[1:], strict=False))
        return self.px_per_dioptre * max(*ends, *(gap / 2.0 for gap in gaps), 0.0)

    @property
    def largest_coc_px(self) -> float:
        """The largest blur of anything within the range in any slice: what a network has to reach."""
        within = (1.0 / self.range.near_m, 1.0 / self.range.far_m)
        return max(
            lens.coc_px_per_dioptre(self.image_width_px) * abs(focus - seen)
            for lens, focus in zip(self.lenses, self.dioptres, strict=True)
            for seen in within
        )

    @property
    def breathing(self) -> tuple[float, ...]:
        """Size of the picture in each slice over that in the nearest one: d_s / d_s of the nearest."""
        return tuple(lens.image_distance_mm / self.lenses[0].image_distance_mm for lens in self.lenses)


def plan_focus(lens: Lens, focus_range: FocusRange, image_width_px: int, residual_px: float = 1.0) -> FocusPlan:
    """As few slices as keep the residual circle of confusion at residual_px (a diameter), the first near, the last far."""
    step = _step_dioptres(lens, focus_range, image_width_px, residual_px)
    gaps = math.ceil(focus_range.dioptres / step - _ROUNDING)
    _require_feasible(gaps + 1, residual_px)
    near, far = 1.0 / focus_range.near_m, 1.0 / focus_range.far_m
    dioptres = (*(near + (far - near) * index / gaps for index in range(gaps)), far)
    return FocusPlan(lens, image_width_px, focus_range, dioptres, residual_px)


def plan_for_motor(
    lens: Lens, focus_range: FocusRange, image_width_px: int, residual_px: float, *, motor_step_dioptres: float
) -> FocusPlan:
    """The same with slices a whole number of motor steps apart, so that a motor that only counts can reach them."""
    if not motor_step_dioptres > 0.0:
        raise InputError(f"a motor step must be a positive number of dioptres, got {motor_step_dioptres:g}")
    step = _step_dioptres(lens, focus_range, image_width_px, residual_px)
    step = max(1, math.floor(step / motor_step_dioptres + _ROUNDING)) * motor_step_dioptres
    gaps = math.ceil(focus_range.dioptres / step - _ROUNDING)
    _require_feasible(gaps + 1, residual_px)
    # No lens focuses beyond infinity, hence the last gap may be shorter.
    dioptres = tuple(max(1.0 / focus_range.near_m - step * index, 0.0) for index in range(gaps + 1))
    return FocusPlan(lens, image_width_px, focus_range, dioptres, residual_px)


def on_scale(plan: FocusPlan, marks_m: Sequence[float]) -> FocusPlan:
    """Every slice at the nearest mark (in dioptres) of a distance scale; marks in metres from the lens, no mark twice.

    A scale with few marks leaves larger gaps: `residual_px` of the result tells.
    """
    if not marks_m or not all(each > 0.0 for each in marks_m):
        raise InputError(f"expected a distance scale of positive metres, got {list(marks_m)}")
    marks = [1.0 / each for each in marks_m]
    chosen = {min(marks, key=lambda mark: abs(mark - wanted)) for wanted in plan.dioptres}
    return FocusPlan(plan.lens, plan.image_width_px, plan.range, tuple(sorted(chosen, reverse=True)), plan.wanted_residual_px)


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
