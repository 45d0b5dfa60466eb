"""A focus motor that only counts: end stops, play, the scale of its steps given and measured; and reading the live view."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from capture.tether.camera_driver import CameraDescription, EndStop, FocusSteps, Preview, Stop, read_focus_steps, write_focus_steps
from capture.tether.focus_motor import FocusAxis, FocusSweep, Target, TravelEndError, measure_focus_steps, peak_steps
from capture.tether.focus_plan import FocusRange, plan_focus
from capture.tether.live_view import Spot, read_live, show_live
from capture.tether.simulated_camera import SimulatedCamera, SimulatedMotor
from mrbokeh.optics.lens import Lens
from mrbokeh.system.errors import InputError
from tests.support.refusals import refused

LENS = Lens(35.0, 2.0, 1.0, 23.5)


@dataclass
class MotorOnly:
    """A CameraDriver of which only the motor matters."""

    motor: SimulatedMotor
    moves: list[int] = field(default_factory=list)

    def describe(self) -> CameraDescription:
        return CameraDescription("motor", "memory", frozenset())

    def _not_here(self, *_: object) -> Any:
        raise NotImplementedError

    configure = preview = capture = _not_here

    def close(self) -> None: ...

    def focus_step(self, steps: int) -> None:
        self.moves.append(steps)
        self.motor.drive(steps)

    def home(self, stop: Stop) -> None:
        with pytest.raises(EndStop):
            self.motor.drive(-stop.away * 100000)


def axis_of(stop: Stop = Stop.near, backlash_steps: int = 60) -> tuple[FocusAxis, MotorOnly, list[float]]:
    """Of a motor with 1000 steps of travel and a play of 40."""
    camera, waits = MotorOnly(SimulatedMotor(2.0, travel_steps=1000, backlash_steps=40)), []
    return FocusAxis(camera, stop, backlash_steps=backlash_steps, settle_s=0.4, sleep=waits.append), camera, waits


def test_the_motor_has_play_and_ends() -> None:
    """40 steps of play: after turning round, 40 steps move nothing, the 41st moves the lens by one."""
    motor = SimulatedMotor(2.0, travel_steps=1000, backlash_steps=40)
    with pytest.raises(EndStop):
        motor.drive(-5000)
    assert motor.lens == 0 and motor.dioptre == 2.0
    motor.drive(40)
    assert motor.lens == 0
    motor.drive(301)
    assert motor.lens == 301
    motor.drive(-40)
    assert motor.lens == 301
    motor.drive(-1)
    assert motor.lens == 300
    with pytest.raises(EndStop):
        motor.drive(5000)
    assert motor.lens == 1000 and motor.dioptre == 0.0
    assert motor.gear == 1040, "pressed against the far stop, all play is behind"
    motor.drive(-41)
    assert motor.lens == 999


@pytest.mark.parametrize("stop", list(Stop))
def test_a_place_is_the_same_from_wherever_one_comes(stop: Stop) -> None:
    """The lens itself, not the count, stands in the same place, to the step."""
    axis, camera, _ = axis_of(stop)
    axis.move_to(300)
    there = camera.motor.lens
    for detour in (500, 301, 20, 900, 340):
        axis.move_to(detour)
        axis.move_to(300)
        assert camera.motor.lens == there and axis.steps == 300
    axis.move_to(300)
    assert camera.motor.lens == there


def test_without_compensation_or_from_the_other_side_it_is_not() -> None:
    """The same ways with no room for the play, and by plain steps back: off by the play of 40 steps (0.08 D)."""
    axis, camera, _ = axis_of(backlash_steps=0)
    axis.move_to(300)
    there = camera.motor.lens
    axis.move_to(500)
    axis.move_to(300)
    assert camera.motor.lens == there + 40
    careful, camera, _ = axis_of()
    careful.move_to(500)
    camera.focus_step(-200)
    assert camera.motor.lens == there + 40, "counting back without coming from behind"


def test_going_back_overshoots_or_homes_and_settles() -> None:
    axis, camera, waits = axis_of()
    axis.move_to(300)
    axis.move_to(200)
    assert camera.moves == [300, -160, 60]
    axis.move_to(50)
    assert camera.moves[3:] == [50], "nearer to the stop than the play: from the stop"
    assert waits == [0.4, 0.4, 0.4]


@pytest.mark.parametrize("stop", list(Stop))
def test_the_ends_of_the_travel(stop: Stop) -> None:
    axis, camera, _ = axis_of(stop)
    with pytest.raises(TravelEndError, match="between 0 and 1041 steps"):
        axis.move_to(1041)
    assert axis.steps is None, "where it stopped, nobody knows"
    axis.move_to(1040)
    assert camera.motor.lens == (1000 if stop is Stop.near else 0)
    refused("cannot be reached", axis.move_to, -1)


def test_steps_and_dioptres() -> None:
    """Two points make a line, which goes on beyond them; a third bends it. From the infinity stop dioptres grow."""
    two = FocusSteps(Stop.near, ((100.0, 2.0), (1100.0, 1.0)))
    assert [two.steps_at(each) for each in (2.0, 1.5, 1.0, 0.5, 2.05)] == [100, 600, 1100, 1600, 50]
    assert two.dioptre_at(600) == pytest.approx(1.5) and two.dioptres_per_step == pytest.approx(0.001)
    three = FocusSteps(Stop.infinity, ((0.0, 0.0), (100.0, 1.0), (400.0, 2.0)))
    assert [three.steps_at(each) for each in (0.5, 1.0, 1.5, 2.5)] == [50, 100, 250, 550]
    assert all(three.dioptre_at(three.steps_at(each)) == pytest.approx(each, abs=0.01) for each in (0.3, 1.3, 1.9))


def test_scales_that_cannot_be() -> None:
    near = [((0.0, 2.0),), ((0.0, 1.0), (9.0, 2.0)), ((9.0, 2.0), (9.0, 1.0))]
    for stop, points in (*((Stop.near, each) for each in near), (Stop.infinity, ((0.0, 2.0), (9.0, 1.0)))):
        refused("at least two points", FocusSteps, stop, points)


def test_the_scale_as_a_file(tmp_path: Path) -> None:
    steps = FocusSteps(Stop.infinity, ((10.5, 0.0), (400.0, 2.0)))
    write_focus_steps(tmp_path / "focus_steps.json", steps)
    assert read_focus_steps(tmp_path / "focus_steps.json") == steps
    for text in ('{"format": "x"}', '{"format": "mrbokeh-focus-steps", "version": 1, "stop": "near", "points": [1]}'):
        (tmp_path / "broken.json").write_text(text)
        refused(r"broken\.json", read_focus_steps, tmp_path / "broken.json")


def test_steps_measured_by_the_live_view() -> None:
    """Two cards at known distances. The true scale of the motor (0.0012 D per step) is found to a tenth of a slice's gap.

    The gap of the plan is 0.27 D; the play of 40 steps belongs to the scale, since it is passed in the same way when shooting.
    """
    plan = plan_focus(LENS, FocusRange(0.5, 2.5), 240)
    camera = SimulatedCamera.for_plan(plan)
    axis = FocusAxis(camera, Stop.near, backlash_steps=100, sleep=lambda _: None)
    near, middle = Target(Spot(0.22, 0.58), 0.5), Target(Spot(0.73, 0.44), 1.0 / 1.2)
    found = measure_focus_steps(axis, camera, [middle, near], step=100, frames=1)
    for dioptre in (2.0, 1.2, 0.4):
        true = camera.motor.focus_steps.steps_at(dioptre)
        assert abs(found.dioptre_at(true) - dioptre) < 0.1 * (plan.dioptres[0] - plan.dioptres[1])


def test_peaks_of_a_sweep() -> None:
    """A flat noisy top between even slopes has its middle where the slopes say; one that has no second slope has none."""
    steps = np.arange(0.0, 1100.0, 100.0)
    flat = np.array([[0.1, 0.1, 0.3, 0.7, 0.97, 1.0, 0.98, 0.96, 0.7, 0.3, 0.1]])
    target = Target(Spot(), 1.0)
    assert peak_steps(FocusSweep(steps, flat), 0, target) == pytest.approx(550.0, abs=15.0)
    refused("end of the focus travel", peak_steps, FocusSweep(steps, np.linspace(0.1, 1.0, 11)[None]), 0, target)


def test_targets_that_tell_nothing() -> None:
    camera = SimulatedCamera.for_plan(plan_focus(LENS, FocusRange(0.5, 2.5), 96))
    axis = FocusAxis(camera, Stop.near, backlash_steps=100, sleep=lambda _: None)
    for targets in ([Target(Spot(), 1.0)], [Target(Spot(), 1.0), Target(Spot(0.1), 1.0)], [Target(Spot(), 1.0), Target(Spot(), -1.0)]):
        with pytest.raises(InputError):
            measure_focus_steps(axis, camera, targets, step=100)


def checkerboard(dark: int, light: int) -> Preview:
    cells = (np.arange(64)[:, None] // 4 + np.arange(96)[None] // 4) % 2
    return np.repeat(np.where(cells, light, dark).astype(np.uint8)[..., None], 3, axis=2)


def test_exposure_read_out() -> None:
    """A quarter clipped, half black; the histogram counts every pixel once."""
    preview = np.full((40, 40, 3), 120, np.uint8)
    preview[:10], preview[20:] = 255, 0
    reading = read_live(preview)
    assert (reading.clipped, reading.black) == (0.25, 0.5) and reading.histogram.sum() == pytest.approx(1.0)
    assert reading.histogram[[0, 15, 31]] == pytest.approx([0.5, 0.25, 0.25])
    assert reading.bars()[0] == "█" and len(reading.bars()) == 32
    one_channel = np.full((8, 8, 3), 100, np.uint8)
    one_channel[..., 0] = 255
    assert read_live(one_channel).clipped == 1.0, "one full channel is enough to lose colour"


def test_sharpness_does_not_depend_on_exposure_but_on_blur() -> None:
    """Half the light: linear 0.7 and 0.35 of the same pattern, as sRGB codes 218 and 159 (IEC 61966-2-1), over nearly black."""
    bright, dim = (read_live(checkerboard(0, code)).sharpness for code in (218, 159))
    assert dim == pytest.approx(bright, rel=0.02)
    soft = checkerboard(0, 218).astype(np.float32)
    soft = (0.25 * (np.roll(soft, 1, 0) + 2.0 * soft + np.roll(soft, -1, 0))).astype(np.uint8)
    assert read_live(soft).sharpness < 0.8 * bright


def test_a_spot_reads_its_own_part() -> None:
    preview = np.concatenate([checkerboard(0, 200), np.full((64, 96, 3), 100, np.uint8)], axis=1)
    left, right = (read_live(preview, Spot(x, 0.5, 0.1)) for x in (0.25, 0.75))
    assert right.sharpness < 1e-6 < left.sharpness and Spot(0.0, 1.0, 0.1).cut(preview).shape == (20, 20, 3)
    refused("a spot needs", Spot, 1.2, 0.5)


def test_the_live_table(capsys: pytest.CaptureFixture[str]) -> None:
    from rich.console import Console

    camera = SimulatedCamera.for_plan(plan_focus(LENS, FocusRange(0.5, 2.5), 96))
    frames = iter([False, False, True])
    reading = show_live(camera, lambda: next(frames), Console(width=100, force_terminal=True))
    assert reading.sharpness > 0.0 and next(frames, None) is None
    shown = capsys.readouterr().out
    assert "sharpness" in shown and "% of the best" in shown and "clipped" in shown
