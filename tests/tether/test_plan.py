"""The focus plan: how many slices keep the residual blur, against numbers worked out by hand and against brute force."""

import csv
import json
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from capture.commands.plan import plan_command
from capture.tether import focus_plan
from capture.tether.focus_plan import FocusPlan, FocusRange, on_scale, plan_focus, plan_for_motor, plan_from_json, plan_to_json, read_plan
from mrbokeh.optics.lens import Lens, film_plane_m, lens_distance_m
from mrbokeh.optics.lens_file import write_lens
from mrbokeh.system.errors import InputError
from tests.support.command_line import printed_by
from tests.support.refusals import refused

LENS = Lens(35.0, 2.8, 1.0, 36.0)
COMMAND = ["--focal-length", "35", "--f-number", "2", "--sensor-width", "23.5", "--near", "0.5", "--far", "2", "--image-width", "480"]


def test_a_measured_stack() -> None:
    """A stack that was made and measured: 35 mm f/2.8 on 36 mm, 960 px, 0.152 D between slices: 12.1 px per dioptre, 0.9 px.

    By hand: a = 35 / 2.8 = 12.5 mm; focused at 1 m, d_s = 35 * 1000 / 965 = 36.269 mm; (960 / 36) * 12.5 * 36.269 / 1000 = 12.09.
    """
    plan = FocusPlan(LENS, 960, FocusRange(1.0, 1.0 / 0.848), (1.0, 0.848))
    assert plan.px_per_dioptre == pytest.approx(960 / 36 * 12.5 * (35_000 / 965) / 1000)
    assert plan.px_per_dioptre == pytest.approx(12.1, abs=0.05)
    assert plan.residual_px == pytest.approx(12.1 * 0.076, abs=0.01)


def test_slices_by_hand() -> None:
    """50 mm f/2 on 36 mm, 6000 px, 0.5 m to infinity: a = 25 mm, d_s = 50 * 500 / 450 = 55.556 mm, 231.48 px per dioptre;
    2 D at 2 / 231.48 D a gap are 231.48 gaps, so 232 gaps and 233 slices. Largest blur: infinity in the nearest slice, 462.96 px.
    """
    plan = plan_focus(Lens(50.0, 2.0, 1.0, 36.0), FocusRange(0.5, math.inf), 6000)
    assert len(plan) == 233
    assert plan.dioptres[0] == 2.0 and plan.dioptres[-1] == 0.0 and math.isinf(plan.lenses[-1].focus_distance_m)
    assert np.diff(plan.dioptres) == pytest.approx([-2.0 / 232] * 232)
    assert plan.residual_px == pytest.approx(231.4815 / 232, rel=1e-6) and plan.residual_px <= 1.0
    assert plan.largest_coc_px == pytest.approx(462.963, abs=0.001)


def test_residual_against_brute_force() -> None:
    """Everything between near and far in the slice that shows it sharpest, as `Lens.coc_px` has it, in pixels of the slice that
    has the narrowest view (1 / breathing). Uneven slices inside the range, so that the ends count too.
    """
    plan = FocusPlan(LENS, 3000, FocusRange(0.5, 5.0), (1.9, 1.5, 1.0, 0.45, 0.25))
    depths_m = 1.0 / np.linspace(2.0, 0.2, 20001)
    blurs = [np.abs(lens.coc_px(depths_m, 3000)) / scale for lens, scale in zip(plan.lenses, plan.breathing, strict=True)]
    assert plan.residual_px == pytest.approx(float(np.min(blurs, axis=0).max()), rel=1e-3)
    largest = max(float(np.abs(lens.coc_px(depths_m, 3000)).max()) for lens in plan.lenses)
    assert plan.largest_coc_px == pytest.approx(largest, rel=1e-9)


def test_distances_and_breathing() -> None:
    """35 mm at 0.5 m: d_s = 17500 / 465 = 37.634 mm, so 0.53763 m from the film plane; at infinity d_s = 35, 0.93 of it."""
    plan = plan_focus(LENS, FocusRange(0.5, math.inf), 960)
    assert film_plane_m(plan.lenses[0]) == pytest.approx(0.537634, abs=1e-6)
    assert lens_distance_m(film_plane_m(plan.lenses[0]), 35.0) == pytest.approx(0.5), "what reading metadata does, undone"
    assert plan.breathing[0] == 1.0 and plan.breathing[-1] == pytest.approx(0.93)
    from_film = FocusRange.from_film_plane(0.537634, math.inf, 35.0)
    assert from_film.near_m == pytest.approx(0.5, abs=1e-5) and math.isinf(from_film.far_m)


@pytest.mark.parametrize("residual_px", [0.5, 1.0, 3.3])
def test_one_slice_less_would_not_do(residual_px: float) -> None:
    focus_range = FocusRange(0.45, 4.0)
    plan = plan_focus(LENS, focus_range, 3000, residual_px)
    fewer = FocusPlan(LENS, 3000, focus_range, tuple(np.linspace(plan.dioptres[0], plan.dioptres[-1], len(plan) - 1).tolist()))
    assert plan.residual_px <= residual_px < fewer.residual_px
    one = plan_focus(LENS, FocusRange(2.0, 2.0), 960)
    assert one.dioptres == (0.5,) and one.residual_px == 0.0


def test_motor_steps() -> None:
    """Gaps are whole motor steps and never larger than without a motor; the range is covered to its far end."""
    focus_range = FocusRange(0.5, 2.5)
    free, plan = plan_focus(LENS, focus_range, 960), plan_for_motor(LENS, focus_range, 960, 1.0, motor_step_dioptres=0.03)
    steps = -np.diff(plan.dioptres) / 0.03
    assert steps == pytest.approx(np.round(steps)) and np.ptp(steps) < 1e-9
    assert plan.residual_px <= 1.0 and len(plan) >= len(free) and plan.dioptres[-1] <= 0.4 < plan.dioptres[-2]
    coarse = plan_for_motor(LENS, focus_range, 960, 1.0, motor_step_dioptres=0.4)
    assert -np.diff(coarse.dioptres) == pytest.approx([0.4] * 4) and coarse.residual_px > 1.0
    assert plan_for_motor(LENS, FocusRange(0.5, math.inf), 960, 1.0, motor_step_dioptres=0.07).dioptres[-1] == 0.0


def test_marks_of_a_scale() -> None:
    """Planned 2, 1.75 ... 0 D; marks at 0.5, 0.7, 1, 2 m and infinity: each once, and the gap from 1/0.7 to 1 D is not the largest."""
    plan = on_scale(plan_focus(LENS, FocusRange(0.5, math.inf), 960, 1.5), [1.0, 0.5, 0.7, 2.0, math.inf])
    assert plan.dioptres == pytest.approx((2.0, 1 / 0.7, 1.0, 0.5, 0.0))
    assert plan.residual_px == pytest.approx(plan.px_per_dioptre * (2.0 - 1 / 0.7) / 2)
    assert plan.residual_px > plan.wanted_residual_px


def test_the_plan_file_keeps_everything(tmp_path: Path) -> None:
    plan = plan_focus(LENS, FocusRange(0.5, math.inf), 960, 2.0)
    focus_plan.write_plan(tmp_path / "plan.json", plan)
    again = read_plan(tmp_path / "plan.json")
    assert plan_to_json(again) == plan_to_json(plan) and again.dioptres == plan.dioptres and again.range == plan.range
    document = json.loads((tmp_path / "plan.json").read_text())
    assert document["version"] == 1 and document["slices"][-1]["focus_distance_m"] is None
    refused("focus plan of version 1", plan_from_json, document | {"version": 2})
    for broken in ({"slices": [{}]}, {"slices": []}, {"near_m": "x"}, {"lens": None}, {"slices": [{"dioptre": 1.0}, {"dioptre": 2.0}]}):
        with pytest.raises(InputError):
            plan_from_json(document | broken)


@pytest.mark.parametrize(
    ("near", "far", "width", "residual", "said"),
    [
        (2.0, 1.0, 960, 1.0, "not beyond"), (0.0, 1.0, 960, 1.0, "above 0"), (0.5, 2.0, 960, 0.0, "positive residual"),
        (0.5, math.inf, 60000, 0.1, "slices would be needed"), (0.03, 1.0, 960, 1.0, "cannot focus at"),
    ],
)  # fmt: skip
def test_plans_that_cannot_be(near: float, far: float, width: int, residual: float, said: str) -> None:
    refused(said, lambda: plan_focus(LENS, FocusRange(near, far), width, residual))
    assert focus_plan.MOST_SLICES == 999


def test_other_mistakes() -> None:
    refused(r"at least 0\.14 m from the film plane", FocusRange.from_film_plane, 0.1, 1.0, 35.0)
    refused("motor step", plan_for_motor, LENS, FocusRange(0.5, 1.0), 960, 1.0, motor_step_dioptres=0.0)
    refused("distance scale", on_scale, plan_focus(LENS, FocusRange(0.5, 1.0), 960), [0.0])


def test_the_command_prints_and_writes(tmp_path: Path) -> None:
    """d_s = 37.634 mm, a = 17.5 mm: 13.45 px per dioptre; 1.5 D are 10.09 gaps of 2 px, so 12 slices."""
    words = [*COMMAND, "--out", tmp_path / "plan.json", "--csv", tmp_path / "plan.csv"]
    told = printed_by(plan_command, *words)
    assert "12 slices of 480 px" in told and "0.5376" in told
    rows = list(csv.DictReader((tmp_path / "plan.csv").read_text().splitlines()))
    assert len(rows) == 12
    assert rows[0] == {"slice": "0", "from_lens_m": "0.5000", "from_film_plane_m": "0.5376", "dioptre": "2.0000", "breathing": "1.00000"}
    assert read_plan(tmp_path / "plan.json").range == FocusRange(0.5, 2.0)
    refused("exists already", printed_by, plan_command, *words)


def test_a_lens_file_and_a_scale(tmp_path: Path) -> None:
    """Marks are engraved from the film plane: 0.5376 m is 0.5 m from the lens."""
    write_lens(tmp_path / "lens.json", replace(LENS, f_number=2.0, sensor_width_mm=23.5))
    marks = ["--scale", "0.537634,1,inf", "--origin", "film_plane", "--near", "0.537634"]
    told = printed_by(plan_command, tmp_path / "lens.json", *COMMAND[6:], *marks)
    assert "3 slices" in told and "0.5376" in told and "above the 1 px" in told


@pytest.mark.parametrize(
    ("more", "said"),
    [
        (["--scale", "1", "--motor-step", "0.1"], "either --scale"), (["--scale", "a"], "--scale must be metres"),
        (["--origin", "sensor"], "--origin must be"),
    ],
)  # fmt: skip
def test_mistakes_of_the_command(more: list[str], said: str) -> None:
    refused(said, printed_by, plan_command, *COMMAND, *more)
    refused("give a lens file", printed_by, plan_command, *COMMAND[2:])
