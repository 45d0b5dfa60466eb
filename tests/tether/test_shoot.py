"""Focus brackets from plan to focal stack with the simulated camera; interruption, checks, and what goes into the sidecar."""

import json
import math
import tomllib
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from datetime import datetime
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from capture.commands.shoot import shoot_command
from capture.photos.metadata import read_metadata
from capture.stacks.ingest import ingest
from capture.tether.camera_driver import CameraError, CameraSettings, FocusSteps, Shot, Stop, read_focus_steps
from capture.tether.focus_plan import FocusPlan, FocusRange, plan_focus, write_plan
from capture.tether.shoot import ShootOptions, Surroundings, shoot
from capture.tether.shoot_files import read_log, save_shot
from capture.tether.simulated_camera import SimulatedCamera
from datasets_scripts.made_sets.simulated_camera import SensorModel, ShotMetadata, write_dng
from mrbokeh.optics.lens import Lens
from mrbokeh.stacks.focal_stack import read_focal_stack
from mrbokeh.system.errors import InputError
from tests.support.command_line import printed_by
from tests.support.refusals import refused

LENS = Lens(35.0, 2.0, 1.0, 23.5)
NEAR_M, FAR_M = 0.5, 2.5


@cache
def small_plan(width_px: int = 160, residual_px: float = 1.2) -> FocusPlan:
    return plan_focus(LENS, FocusRange(NEAR_M, FAR_M), width_px, residual_px)


@cache
def simulated(plan: FocusPlan) -> SimulatedCamera:
    """One for all tests of a plan: it draws its scene once."""
    return SimulatedCamera.for_plan(plan)


FEW = small_plan(96, 2.0)


@dataclass
class WatchedCamera(SimulatedCamera):
    """What may happen to a real one: `before_shot` is called with the number of the shot, from 1."""

    before_shot: Callable[[int], None] = lambda _: None
    homings: list[Stop] = field(default_factory=list)

    def capture(self) -> Shot:
        self.before_shot(self.shots + 1)
        return super().capture()

    def home(self, stop: Stop) -> None:
        self.homings.append(stop)
        super().home(stop)


def camera_for(plan: FocusPlan, before_shot: Callable[[int], None] = lambda _: None) -> WatchedCamera:
    one = simulated(plan)
    return WatchedCamera(one.lens, one.scene, replace(one.motor), one.width_px, before_shot=before_shot)


def taken(plan: FocusPlan, camera: SimulatedCamera, out: Path, **options: object) -> tuple[dict, list[str]]:
    said = list[str]()
    around = Surroundings(said.append, said.append, lambda _: None, lambda: datetime(2026, 1, 2, 3, 4, 5))
    shoot(plan, camera, out, ShootOptions(**{"backlash_steps": 100} | options), around)
    return json.loads((out / "shoot.json").read_text()), said


def real_dioptres(document: dict, camera: SimulatedCamera) -> list[float]:
    """What was in focus, from the steps in the log and the camera's true scale."""
    return [camera.motor.focus_steps.dioptre_at(each["steps"]) for each in document["slices"]]


def test_from_plan_to_depth(tmp_path: Path) -> None:
    """Shoot, ingest and merge: slices in order, distances within Nikon's quantum, and each card at its depth.

    The quantum is 5.9 %, half of it 2.9 %, which at 0.5 m is 0.06 D; depth from focus adds a tenth of a gap (0.32 D).
    """
    plan = small_plan(240, 1.2)
    camera = camera_for(plan)
    document, said = taken(plan, camera, tmp_path / "session" / "view_0")
    assert said == [] and camera.homings == [Stop.near]
    assert [each["file"] for each in document["slices"]] == [f"slice_{index:02d}.tif" for index in range(len(plan))]
    assert real_dioptres(document, camera) == pytest.approx(plan.dioptres, abs=6e-4), "half a motor step"
    steps = [each["steps"] for each in document["slices"]]
    assert steps == sorted(steps) and document["check"]["steps"] == steps[0]
    assert document["settings"]["exposure mode"] == "manual"
    live = [each["live"]["sharpness"] for each in document["slices"]]
    assert len(set(live)) == len(plan)

    stack = ingest([tmp_path / "session"], tmp_path / "scene").stacks[0].stack
    assert stack is not None and len(stack.slices) == len(plan)
    assert [Path(each.metadata["source"]).name for each in stack.slices] == [each["file"] for each in document["slices"]]
    stated = [1.0 / each for each in stack.focus_distances_m if each]
    assert all(abs(1.0 / a - 1.0 / b) / (1.0 / b) < 0.032 for a, b in zip(stated, plan.dioptres, strict=True))
    assert stack.lens is not None and stack.lens.sensor_width_mm == pytest.approx(23.5)

    from capture.merging.merge import merge_scene

    merge_scene(tmp_path / "scene", overwrite=False)
    merged = read_focal_stack(tmp_path / "scene" / "view_0")
    depth_m = merged.depth_m()
    height, width = depth_m.shape
    for x, y, dioptre in ((0.22, 0.58, 1.0 / NEAR_M), (0.73, 0.44, 1.2), (0.5, 0.92, 1.0 / FAR_M)):
        row, column = int(y * height), int(x * width)
        found = float(np.median(depth_m[row - 5 : row + 5, column - 8 : column + 8]))
        assert 1.0 / found == pytest.approx(dioptre, abs=0.09)


def test_raw_all_the_way(tmp_path: Path) -> None:
    """The same camera with a Bayer sensor that writes DNG: SubjectDistance comes back to a hundredth of a millimetre."""

    class RawCamera(SimulatedCamera):
        def capture(self) -> Shot:
            lens, sensor = self.focused_lens, SensorModel()
            light = self.scene.photographed(lens, self.width_px, 106)
            mosaic = sensor.quantise(sensor.expose(sensor.linear_mosaic(light), np.random.default_rng(self.shots)))
            self.shots += 1
            write_dng(tmp_path / "card.dng", mosaic, sensor, ShotMetadata(lens))
            return Shot((tmp_path / "card.dng").read_bytes(), f"DSC_{self.shots:04d}.DNG", self.counter)

    plan = small_plan(160, 4.0)
    document, said = taken(plan, RawCamera.for_plan(plan), tmp_path / "view")
    assert said == [] and [each["file"] for each in document["slices"]] == [f"slice_{index:02d}.dng" for index in range(len(plan))]
    assert not (tmp_path / "view" / "lens.toml").exists()
    stack = ingest([tmp_path / "view"], tmp_path / "scene").stacks[0].stack
    assert [1.0 / each for each in stack.focus_distances_m if each] == pytest.approx(plan.dioptres, abs=6e-4)


def test_a_pulled_cable(tmp_path: Path) -> None:
    """Three slices, then nothing: they are kept, the next run homes again, takes the rest and only that, and all fits the plan."""
    plan = small_plan()
    with pytest.raises(InputError, match=r"slice 3 could not be taken: the connection broke.*3 slices are kept"):
        taken(plan, camera_for(plan, raising(4, CameraError("the connection broke: check the cable and the battery"))), tmp_path)
    assert sorted(read_log(tmp_path).slices) == [0, 1, 2]
    assert sorted(each.name for each in tmp_path.iterdir()) == ["shoot.json", "slice_00.tif", "slice_01.tif", "slice_02.tif"]
    before, camera = (tmp_path / "slice_01.tif").stat().st_mtime_ns, camera_for(plan)
    document, said = taken(plan, camera, tmp_path)
    assert said == [] and camera.homings == [Stop.near] and camera.shots == len(plan) - 3 + 1
    assert (tmp_path / "slice_01.tif").stat().st_mtime_ns == before
    assert real_dioptres(document, camera) == pytest.approx(plan.dioptres, abs=6e-4)
    assert abs(document["check"]["focus_error"]) < 0.05, "after homing again the focus is where it was"


def raising(at_shot: int, error: BaseException) -> Callable[[int], None]:
    def before_shot(shot: int) -> None:
        if shot == at_shot:
            raise error

    return before_shot


def test_ctrl_c_keeps_everything_and_a_lost_file_is_taken_again(tmp_path: Path) -> None:
    with pytest.raises(KeyboardInterrupt):
        taken(FEW, camera_for(FEW, raising(3, KeyboardInterrupt())), tmp_path)
    (tmp_path / "slice_00.tif").unlink()
    camera = camera_for(FEW)
    document, _ = taken(FEW, camera, tmp_path)
    assert [each["camera_name"] for each in document["slices"]][:2] == ["SIM_0001.TIF", "SIM_0002.TIF"]
    assert camera.shots == len(FEW) - 1 + 1, "slice 0 and those after 1, and the check"
    _, said = taken(FEW, camera, tmp_path)
    assert said == [f"all {len(FEW)} slices are in {tmp_path} already"] and camera.shots == len(FEW)


def test_a_shoot_goes_on_only_as_it_was(tmp_path: Path) -> None:
    camera = camera_for(FEW)
    taken(FEW, camera, tmp_path)
    refused("another plan", taken, small_plan(96, 3.0), camera, tmp_path)
    (tmp_path / "slice_01.tif").unlink()
    refused(r"other settings \(exposure time", taken, FEW, camera, tmp_path, settings=CameraSettings(exposure_time_s=0.5))
    document, _ = taken(small_plan(96, 3.0), camera, tmp_path, overwrite=True)
    assert sorted(each.name for each in tmp_path.glob("slice_*")) == [each["file"] for each in document["slices"]]
    (tmp_path / "other").mkdir()
    (tmp_path / "other" / "a.jpg").write_bytes(b"x")
    refused(r"not of this shoot \(a\.jpg", taken, FEW, camera, tmp_path / "other")
    (tmp_path / "shoot.json").write_text('{"format": "mrbokeh-shoot", "version": 1}')
    refused("damaged", taken, FEW, camera, tmp_path)


@pytest.mark.slow
@pytest.mark.parametrize(("bump_gaps", "warned"), [(0.0, False), (0.1, False), (0.5, True), (-0.6, True)])
def test_slice_0_shot_again_tells_a_bumped_ring(tmp_path: Path, bump_gaps: float, warned: bool) -> None:
    """The lens slips on its gear before the last shot. The error comes out in gaps between slices, with its sign.

    Blur below a pixel does not show, so errors below a gap come out up to half as large; the limit of the warning is 0.15.
    """
    plan = small_plan()
    gap_steps = (plan.dioptres[0] - plan.dioptres[1]) / 2.4 * 2400
    camera = camera_for(plan)
    camera.before_shot = lambda shot: slip(camera, gap_steps * bump_gaps) if shot == len(plan) + 1 else None
    document, said = taken(plan, camera, tmp_path)
    assert document["check"]["focus_error"] == pytest.approx(bump_gaps, abs=max(0.02, 0.5 * abs(bump_gaps)))
    assert [("the focus did not come back" in each) for each in said] == ([True] if warned else [])
    assert document["check"]["warnings"] == [each.removeprefix("warning: ") for each in said]


def slip(camera: SimulatedCamera, steps: float) -> None:
    camera.motor.lens += steps
    camera.motor.gear += steps


@pytest.mark.parametrize(("backlash_steps", "enough"), [(0, False), (220, True)])
def test_too_little_room_for_the_play_is_noticed(backlash_steps: int, enough: bool, tmp_path: Path) -> None:
    """Slice 0 lies beyond the near stop, so going back to it turns the motor round: with --backlash 0, the play of 200 steps stays."""
    camera = camera_for(small_plan())
    camera.motor.backlash_steps = 200
    document, said = taken(small_plan(), camera, tmp_path, backlash_steps=backlash_steps)
    if enough:
        assert abs(document["check"]["focus_error"]) < 0.02 and said == []
    else:
        assert document["check"]["focus_error"] > 0.15 and "play is larger than --backlash" in said[0]


def test_a_moved_camera_and_changed_light_are_noticed(tmp_path: Path) -> None:
    plan = small_plan()
    camera = camera_for(plan)

    def disturb(shot: int) -> None:
        if shot == len(plan) + 1:
            cards = (replace(each, left=each.left + 0.03, right=each.right + 0.03) for each in camera.scene.cards)
            camera.scene = replace(camera.scene, cards=tuple(cards))
            camera.exposure_time_s *= 1.1

    camera.before_shot = disturb
    document, said = taken(plan, camera, tmp_path)
    # 0.03 of 160 px, times the breathing of the nearest slice, 37.6 / 35.
    assert document["check"]["shift_px"] == pytest.approx(0.03 * 160 * 37.63 / 35.0, abs=0.3)
    assert document["check"]["brightness"] == pytest.approx(1.1, abs=0.02)
    assert any("the camera moved" in each for each in said) and any("1.10 times as bright" in each for each in said)


def test_automatic_exposure_is_refused(tmp_path: Path) -> None:
    camera = camera_for(FEW)
    camera.before_shot = lambda shot: setattr(camera, "exposure_time_s", 1 / 50) if shot == 3 else None
    refused(r"SIM_0003\.TIF was exposed otherwise .* set the camera to manual exposure", taken, FEW, camera, tmp_path)
    assert sorted(each.name for each in tmp_path.glob("slice*")) == ["slice_00.tif", "slice_01.tif"]


def test_half_a_file_is_not_kept(tmp_path: Path) -> None:
    shot = SimulatedCamera.for_plan(small_plan(96)).capture()
    with pytest.raises(CameraError, match="did not arrive whole"):
        save_shot(replace(shot, data=shot.data[: len(shot.data) // 2]), tmp_path, "slice_00")
    with pytest.raises(CameraError, match="no photograph"):
        save_shot(replace(shot, name="MOVIE.MOV"), tmp_path, "slice_00")
    assert list(tmp_path.iterdir()) == []


def test_another_lens_than_planned_is_told(tmp_path: Path) -> None:
    _, said = taken(FEW, camera_for(FEW), tmp_path, settings=CameraSettings(f_number=4.0), check=False)
    assert said == ["the plan is for f_number 2, the photographs state 4: plan again, or set the lens"]


def test_planned_distances_where_the_camera_is_silent(tmp_path: Path) -> None:
    """lens.toml counts from the lens and names the files; ingest reads it."""
    camera = camera_for(FEW)
    camera.quantum = lambda _: None
    taken(FEW, camera, tmp_path / "view", check=False)
    written = tomllib.loads((tmp_path / "view" / "lens.toml").read_text())
    assert set(written) == {"focus_origin", "focus_distances_m"} and written["focus_origin"] == "lens"
    stack = ingest([tmp_path / "view"], tmp_path / "scene").stacks[0].stack
    assert [1.0 / each for each in stack.focus_distances_m if each] == pytest.approx(FEW.dioptres, abs=6e-4)


def test_planned_distances_where_rounding_merges_slices(tmp_path: Path) -> None:
    """Gaps of 2 % against Nikon's steps of 5.9 %: neighbours state the same, so the plan's word is taken; and to infinity."""
    plan = FocusPlan(LENS, 96, FocusRange(1.0, math.inf), (1.0, 0.98, 0.0))
    document, _ = taken(plan, camera_for(plan), tmp_path, check=False)
    assert document["slices"][0]["stated"]["focus_dioptre"] == document["slices"][1]["stated"]["focus_dioptre"]
    distances_m = tomllib.loads((tmp_path / "lens.toml").read_text())["focus_distances_m"]
    assert [1.0 / each for each in distances_m.values()] == pytest.approx([1.0, 0.98, 0.0], abs=6e-4)


def test_planned_distances_on_request_and_a_foreign_sidecar(tmp_path: Path) -> None:
    taken(FEW, camera_for(FEW), tmp_path / "b", check=False, planned_distances=True)
    assert len(tomllib.loads((tmp_path / "b" / "lens.toml").read_text())["focus_distances_m"]) == len(FEW)
    (tmp_path / "c").mkdir()
    foreign = tmp_path / "c" / "lens.toml"
    foreign.write_text("blades = 7\n")
    taken(FEW, camera_for(FEW), tmp_path / "c", check=False, planned_distances=True)
    assert foreign.read_text() == "blades = 7\n"


def test_by_hand(tmp_path: Path) -> None:
    """The photographer is told each distance as the ring counts it (0.5 m from the lens is 0.538 m from the film plane)."""
    camera = camera_for(FEW)
    document, said = taken(FEW, camera, tmp_path, by_hand=True, check=False)
    assert len(said) == len(FEW) and "focus at 0.538 m on the lens's scale (0.500 m from the lens)" in said[0]
    assert [each["dioptre"] for each in document["slices"]] == list(FEW.dioptres) and camera.homings == []


def test_unknown_steps_and_a_range_beyond_the_lens(tmp_path: Path) -> None:
    camera = camera_for(FEW)
    camera.knows_steps = False
    refused("--target", taken, FEW, camera, tmp_path / "unknown")
    beyond, before = (FocusSteps(Stop.near, ((first, 2.0), (last, 0.4))) for first, last in ((200.0, 5000.0), (-200.0, 2000.0)))
    refused("the focus motor met its end", taken, FEW, camera, tmp_path / "beyond", focus_steps=beyond)
    refused("cannot be reached", taken, FEW, camera, tmp_path / "before", focus_steps=before)


def test_from_the_infinity_stop(tmp_path: Path) -> None:
    """Counted from infinity, slices are still taken nearest first, each approached from the far side; the focus is the same."""
    camera = camera_for(FEW)
    scale = FocusSteps(Stop.infinity, ((40.0, 0.0), (2440.0, 2.4)))
    dioptres: list[float] = []
    camera.before_shot = lambda _: dioptres.append(camera.motor.dioptre)
    taken(FEW, camera, tmp_path, focus_steps=scale)
    assert dioptres[:-1] == pytest.approx(FEW.dioptres, abs=6e-4) and dioptres[-1] == dioptres[0]


def shoot_by(folder: Path, *more: str) -> str:
    """What the command prints, which takes the plan of the folder with the simulated camera."""
    words = ["--plan", folder / "plan.json", "--source", "simulated", "--out", folder / "view", "--settle", "0"]
    return printed_by(shoot_command, *words, *more, answer="\n")


def test_the_command(tmp_path: Path) -> None:
    write_plan(tmp_path / "plan.json", FEW)
    told = shoot_by(tmp_path, "--exposure-time", "1/60", "--live", "--spot", "0.5,0.5")
    assert "3 slices" in told and "mrbokeh capture ingest" in told
    assert read_metadata(tmp_path / "view" / "slice_00.tif").exposure_time_s == pytest.approx(1 / 60, rel=1e-3)


def test_the_command_measures_steps_once(tmp_path: Path) -> None:
    write_plan(tmp_path / "plan.json", small_plan(240, 2.0))
    targets = ["--target", "0.5,0.92=2.5", "--target", "0.73,0.44=0.83333", "--sweep-step", "200", "--no-check"]
    assert "dioptres per step" in shoot_by(tmp_path, *targets)
    scale = read_focus_steps(tmp_path / "view" / "focus_steps.json")
    # 2.4 D to 0 in 2400 steps, after 40 steps of play; the gap between slices is 0.53 D.
    assert [scale.dioptre_at(40 + each) for each in (1200, 2000)] == pytest.approx([1.2, 0.4], abs=0.053)
    assert "dioptres per step" not in shoot_by(tmp_path, *targets)


@pytest.mark.parametrize(
    ("more", "said"),
    [
        (["--source", "phone"], "--source must be"),
        (["--exposure-time", "fast"], "seconds such as"), (["--exposure-time", "0"], "got '0'"),
        (["--near-steps", "10"], "belong together"), (["--near-steps", "9", "--far-steps", "20", "--home", "left"], "--home must be"),
        (["--target", "0.5,0.5"], "X,Y=METRES"), (["--target", "0.5=2"], "X,Y from 0 to 1"), (["--spot", "2,2"], "a spot needs"),
        (["--near-steps", "9", "--far-steps", "20", "--target", "0.5,0.5=1"], "both given and to be measured"),
        (["--source", "folder:/nowhere/at/all"], "expected the folder"),
    ],
)  # fmt: skip
def test_mistakes_of_the_command(tmp_path: Path, more: list[str], said: str) -> None:
    write_plan(tmp_path / "plan.json", FEW)
    refused(said, shoot_by, tmp_path, *more)
