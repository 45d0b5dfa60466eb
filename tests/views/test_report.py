"""The report of a scene: one page that works offline, numbers for machines, verdicts of partial scenes, and the small measurements."""

import json
import re
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path

import cv2
import numpy as np
import pytest

from capture.commands.report import report_command
from capture.poses.sparse_model import SparseModel, SparseView, write_sparse_model
from capture.report.exclusion import REASONS, Disagreement, board_mask, exclusion_masks, moving
from capture.report.findings import SliceFindings, StackFindings, focus_curve, focus_spacing
from capture.report.gates import Verdict, verdict_line
from capture.report.picture_sharpness import PictureFindings
from capture.report.registration_check import drift_of
from capture.report.scene_report import SceneReport, poses_view, report_scene, scene_of
from capture.report.slice_fit import low_frequency_gain
from capture.report.stack_gates import Reconstruction, scales_in, scene_gates, stack_gates
from capture.report.stack_section import Axes, chart
from capture.report.stack_view import Reblur
from mrbokeh.images.camera_rgb import write_camera_rgb
from mrbokeh.images.exr_io import ExrPart, write_exr
from mrbokeh.layering.layering import Layering
from mrbokeh.optics.camera import Camera
from mrbokeh.renderers.polygon.polygon_differences import PolygonDifferences
from mrbokeh.stacks.focal_stack import FocalStack, Slice, read_focal_stack, write_focal_stack
from mrbokeh.stacks.guessed_metres import SLICE_POSITION
from mrbokeh.system.atomic_files import write_json
from tests.support.command_line import printed_by
from tests.support.traced_focal_stack import FOCUS_M, traced, write_stack

REBLUR = Reblur(PolygonDifferences(layering=Layering(slices=8), threads=1))


class Page(HTMLParser):
    """Tags in order, and whether every one that must be closed is."""

    VOID = ("meta", "img", "br", "line", "rect", "circle", "polyline", "!doctype")

    def __init__(self, text: str) -> None:
        super().__init__()
        self.open: list[str] = []
        self.sources: list[str] = []
        self.tags: list[str] = []
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append(tag)
        self.sources += [value or "" for name, value in attrs if name in ("src", "href")]
        if tag not in self.VOID:
            self.open.append(tag)

    def handle_endtag(self, tag: str) -> None:
        if tag not in self.VOID:
            assert tag in self.open, f"</{tag}> without <{tag}>"
            while self.open.pop() != tag:
                pass


def sparse_model(names: tuple[str, ...] = ("view_0",)) -> SparseModel:
    """Cameras 0.1 apart that look along z, and eight points before them."""
    views = []
    for index, name in enumerate(names):
        pose = np.eye(4)
        pose[0, 3] = -0.1 * index
        views.append(SparseView(name, Camera(160, 107, (200.0, 200.0), (80.0, 53.5), pose)))
    points = np.array([[x, y, z] for x in (-0.2, 0.2) for y in (-0.1, 0.1) for z in (1.0, 2.0)])
    observations = np.stack([np.zeros(8, int), np.arange(8)], axis=1)
    return SparseModel(tuple(views), points, np.full(8, 0.4), observations, np.zeros((8, 2)), None)


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """One merged stack of a right scene, one that only has slices, and a reconstruction with two scales."""
    folder = tmp_path_factory.mktemp("scene")
    merged = write_stack(folder / "view_0", traced())
    waiting = replace(merged, folder=folder / "view_1", merged=False, registered=False)
    waiting.folder.mkdir()
    write_focal_stack(waiting)
    write_sparse_model(folder / "reconstruction", sparse_model())
    answers = [{"method": "board", "metres_per_unit": 1.0}, {"method": "focus", "metres_per_unit": 1.03}]
    write_json(folder / "reconstruction" / "scale.json", {"metres_per_unit": 1.0, "method": "board", "answers": answers})
    return folder


@pytest.fixture(scope="module")
def report(scene: Path) -> SceneReport:
    return report_scene(scene, REBLUR)


def test_the_page_is_one_file_that_needs_nothing_else_and_its_numbers_are_json(report: SceneReport) -> None:
    reported = report.scene
    page = Page((reported / "report.html").read_text(encoding="utf-8"))
    assert not [tag for tag in page.open if tag not in ("html", "body")], "all tags are closed"
    assert page.sources and all(each.startswith("data:image/") for each in page.sources), "nothing is loaded from elsewhere"
    # 5 maps; slices 0, 3, 5 and perhaps the worst, three pictures each; crops of the worst places, which are no part of these.
    places = sum(len(each.pictures) for each in report.stacks[0].places)
    assert page.tags.count("img") - places in (14, 17)
    assert page.tags.count("canvas") == 1
    assert "viewport" in (reported / "report.html").read_text(encoding="utf-8")
    document = json.loads((reported / "report.json").read_text(), parse_constant=lambda name: pytest.fail(f"{name} is no JSON"))
    assert document["format"] == "mrbokeh-capture-report"
    assert len(document["stacks"]["view_0"]["slices"]) == len(FOCUS_M)
    assert document["stacks"]["view_0"]["slices"][0]["psnr_db"] > 35.0
    assert document["scales_metres_per_unit"] == {"board": 1.0, "focus": 1.03}
    for gate in document["gates"]:
        assert gate["verdict"] in ("passed", "failed", "absent") and gate["why"] and gate["advice"] and gate["limit"]
    masks = read_focal_stack(reported / "view_0").exclusions()
    assert set(masks) == set(REASONS)
    assert all(mask.shape == (107, 160) for mask in masks.values())
    # What fails is what was made wrong: a stack that is not merged, and scales 3 % apart. Absent, not failed: no registration was kept,
    # and 160 x 107 pixels have too few flat blocks.
    assert {each.name for each in report.failures} == {"all stacks merged", "scales agree"}
    absent = {each.name for each in report.gates if each.verdict == "absent"}
    assert absent == {"registration held", "no seams"}


def test_strict_is_told_by_the_exit_code(tmp_path: Path) -> None:
    """A stack that is not merged: quick to judge, and a failure."""
    folder = tmp_path / "view_0"
    write_focal_stack(FocalStack(folder, (Slice("a.exr", 1.0),)))
    printed_by(report_command, tmp_path)
    assert "failed: scene: all stacks merged" in printed_by(report_command, tmp_path, "--strict", exit_code=1)


def test_a_stack_without_lens_is_judged_by_what_is_there(tmp_path: Path) -> None:
    """No focus distances: no prediction, but exposure (low frequencies) and saturation all the same."""
    stack = write_stack(tmp_path / "view_0", traced())
    bare = replace(stack, lens=None, camera=None, slices=tuple(replace(each, focus_distance_m=None) for each in stack.slices))
    bright = read_focal_stack(tmp_path / "view_0").slice_rgb(2) * np.float32(1.1)
    write_camera_rgb(tmp_path / "view_0" / bare.slices[2].path, bright, None)
    write_focal_stack(bare)
    gates = {each.name: each for each in report_scene(tmp_path, REBLUR).gates}
    assert gates["exposure is constant"].failed and gates["exposure is constant"].value == pytest.approx(0.1, abs=0.01)
    assert gates["re-blurred picture is the slice"].verdict == "absent"
    assert gates["no slice missing"].verdict == "absent"


def test_registration_and_spacing_are_read() -> None:
    """Dioptres 2.0, 1.8 ... in equal steps; then without one, with two exchanged, with one twice."""
    even = [1.0 / d for d in (2.0, 1.8, 1.6, 1.4, 1.2, 1.0)]
    assert focus_spacing(even).is_even
    assert focus_spacing(even).usual_step == pytest.approx(0.2)
    assert focus_spacing(even[:3] + even[4:]).gaps == (2,)
    assert focus_spacing([even[i] for i in (0, 1, 3, 2, 4, 5)]).out_of_order == (3,)
    assert focus_spacing(even[:3] + even[2:]).doubled == (3,)
    assert focus_spacing([1.0 / d for d in (2.0, 1.5, 1.13, 0.84, 0.63)]).is_even, "steps that shrink by a quarter each"
    assert focus_spacing([0.5, 1.0, float("inf")]).is_even, "0 dioptres are a focus"
    # A turn of 2 mrad about the middle, a shift of (3, -1) px and 1 % of enlargement about the middle, from their matrices.
    middle = np.array([80.0, 50.0])
    turn = np.array([[np.cos(2e-3), -np.sin(2e-3)], [np.sin(2e-3), np.cos(2e-3)]])
    matrices = [
        np.eye(2, 3),
        *(np.column_stack([a, middle - a @ middle + t]) for a, t in ((turn, (3.0, -1.0)), (1.01 * np.eye(2), (0, 0)))),
    ]
    drift = drift_of(matrices, 160, 100, (0.99, 0.7))
    np.testing.assert_allclose(drift.shift_px, [[0, 0], [3, -1], [0, 0]], atol=1e-9)
    np.testing.assert_allclose(drift.rotation_rad, [0, 2e-3, 0], atol=1e-9)
    np.testing.assert_allclose(drift.magnification, [1, 1, 1.01])
    assert drift.largest_jump_px == pytest.approx(np.hypot(3, 1))
    assert drift.least_correlation == 0.7 and drift.width_px == 160


def test_steps_of_a_solved_focus_are_judged_by_the_blur_that_they_leave(scene: Path) -> None:
    """Two slices at one place lose nothing; 2 px apart all between them is blurred by 1 px or more, 0.6 % of 160 px."""
    stack = read_focal_stack(scene / "view_0")
    picture, found = (
        PictureFindings(0.0, None, None, 1.0, 1.0, (160, 107)),
        tuple(SliceFindings(index, 1.0, 0.0, 1.0) for index in range(6)),
    )
    curve = focus_curve(np.zeros((4, 4), np.float32), np.ones((4, 4), np.float32), 6)
    for step_px, passes in ((1.5, True), (2.0, False)):
        positions_px = np.array([0.0, 0.0, 1.0, 1.0 + step_px, 2.0 + step_px, 3.0 + step_px])
        slices = tuple(replace(each, metadata={SLICE_POSITION: float(at)}) for each, at in zip(stack.slices, positions_px, strict=True))
        of_stack = StackFindings(replace(stack, slices=slices), (160, 107), (160, 107), found, curve, None, None, picture, ())
        gate = next(each for each in stack_gates(of_stack) if each.name == "no slice missing")
        assert gate.failed != passes and gate.measured.startswith("what lies midway between slices 2 and 3") and gate.value == step_px / 320
        other, opposite = replace(gate, where="other"), Verdict.PASSED if gate.failed else Verdict.FAILED
        assert (
            verdict_line("use", [gate, replace(other, verdict=opposite)])
            == f"use: failed: no slice missing ({'other' if passes else 'view_0'})"
        )
        assert (verdict_line("use", [gate, other]) == "use: passed: no slice missing") == passes


def test_movement_is_not_judged_from_three_slices(scene: Path) -> None:
    """People walked through a stack of three slices, and the report said that nothing moved."""
    nothing = np.zeros((20, 30), np.float16)
    quiet = Disagreement(residual=nothing, level=nothing, per_px=nothing, counted=np.ones((20, 30), bool))
    still = moving([quiet] * 4, np.zeros((20, 30), np.float32))
    assert moving([quiet] * 3, np.zeros((20, 30), np.float32)) is None and still is not None and not still.any()
    curve = focus_curve(np.zeros((4, 4), np.float32), np.ones((4, 4), np.float32), 3)
    found = tuple(SliceFindings(index, 1.0, 0.0, 1.0) for index in range(3))
    picture = PictureFindings(0.0, None, None, 1.0, 1.0, (160, 107))
    of_stack = StackFindings(read_focal_stack(scene / "view_0"), (160, 107), (160, 107), found, curve, 0.01, None, picture, ())
    gate = next(each for each in stack_gates(of_stack) if each.name == "nothing moved")
    assert (gate.verdict, gate.measured) == ("absent", "movement shows from 4 slices on, and here are 3: look at the picture yourself")


def test_a_jump_or_a_pair_that_does_not_match_fails_registration(scene: Path, tmp_path: Path) -> None:
    """2 px of 160 are more than 1 %; a drift of 2 px per slice is no jump; a correlation of 0.7 is below 0.8."""
    stack = replace(read_focal_stack(scene / "view_0"), folder=tmp_path)
    curve = focus_curve(np.zeros((4, 4), np.float32), np.ones((4, 4), np.float32), 6)

    def placed(shifts_px: list[float], correlations: tuple[float, ...]) -> FocalStack:
        """As registration leaves it."""
        write_json(tmp_path / "registration.json", {"correlations": correlations})
        matrices = [[[1.0, 0.0, x], [0.0, 1.0, 0.0]] for x in shifts_px]
        pairs = zip(stack.slices, matrices, strict=False)
        return replace(stack, slices=tuple(replace(each, metadata={"reference_from_slice": matrix}) for each, matrix in pairs))

    def verdict(shifts_px: list[float], correlations: tuple[float, ...] = ()) -> str:
        found = tuple(SliceFindings(index, 1.0, 0.0, 1.0) for index in range(len(shifts_px)))
        picture = PictureFindings(0.0, None, None, 1.0, 1.0, (160, 107))
        of_stack = placed(shifts_px, correlations)
        gates = stack_gates(StackFindings(of_stack, (160, 107), (160, 107), found, curve, None, None, picture, ()))
        return str(next(each for each in gates if each.name == "registration held").verdict)

    assert verdict([0.0, 2.0, 4.0, 6.0]) == "passed"
    assert verdict([0.0, 0.0, 2.0, 0.0]) == "failed"
    assert verdict([0.0, 0.0, 0.0], (0.99, 0.7)) == "failed"


def test_gain_and_focus_curve() -> None:
    """Light moved about by a wide blur and 3 % more of it; a saturated corner does not count."""

    sharp = np.random.default_rng(0).random((120, 160, 3)).astype(np.float32)
    blurred = np.float32(1.03) * cv2.GaussianBlur(sharp, (0, 0), 3.0)
    counted = np.ones((120, 160), bool)
    blurred[:30, :30], counted[:30, :30] = 9.0, False
    assert low_frequency_gain(blurred, sharp, counted) == pytest.approx(1.03, abs=0.005)
    assert np.isnan(low_frequency_gain(blurred, sharp, np.zeros_like(counted)))
    # A quarter of the pixels at the first slice, half at slice 2, a quarter that nobody trusts.
    index = np.repeat(np.array([[0.0, 2.1, 1.9, 3.0]], np.float32), 4, axis=0)
    confidence = np.repeat(np.array([[1.0, 1.0, 1.0, 0.0]], np.float32), 4, axis=0)
    curve = focus_curve(index, confidence, 4)
    np.testing.assert_allclose(curve.shares, [1 / 3, 0, 2 / 3, 0])
    assert (curve.trusted, curve.beyond_near, curve.beyond_far) == (0.75, pytest.approx(1 / 3), 0.0)
    assert focus_curve(index, np.zeros_like(confidence), 4).trusted == 0.0


def test_exclusion_masks_by_reason(tmp_path: Path) -> None:
    """Two slices of 8x6: one saturated at a pixel, one without data in a column; confidence 0 in a row; a board; something that moved."""
    folder = tmp_path / "view_0"
    saturated, valid = np.zeros((6, 8), bool), np.ones((6, 8), bool)
    saturated[1, 2], valid[:, 7] = True, False
    grey = np.full((6, 8, 3), 0.5, np.float32)
    write_camera_rgb(folder / "0.exr", grey, None, saturated=saturated)
    write_camera_rgb(folder / "1.exr", grey, None, valid=valid)
    confidence = np.ones((6, 8), np.float32)
    confidence[5] = 0.0
    write_exr(folder / "depth.exr", ExrPart({"confidence": confidence}))
    answers = [{"method": "focus"}, {"method": "board", "outlines_px": {"view_0": [[1.0, 1.0], [4.0, 1.0], [4.0, 3.0], [1.0, 3.0]]}}]
    write_json(tmp_path / "reconstruction" / "scale.json", {"answers": answers})
    stack = FocalStack(folder, (Slice("0.exr", 1.0), Slice("1.exr", 2.0)), registered=True, merged=True)
    moving = np.zeros((3, 4), bool)
    moving[0, 0] = True
    masks = exclusion_masks(stack, moving)
    np.testing.assert_array_equal(masks["saturated"], saturated)
    np.testing.assert_array_equal(masks["border"], ~valid)
    np.testing.assert_array_equal(masks["low_confidence"], confidence == 0)
    assert masks["moving"].sum() == 4 and masks["moving"][:2, :2].all(), "one pixel of half the size"
    assert masks["board"][1:3, 1:4].all() and not masks["board"][4:].any() and not masks["board"][:, 5:].any()
    assert not board_mask(replace(stack, folder=tmp_path / "view_9"), (6, 8)).any()


def test_gates_of_a_reconstruction() -> None:
    model = replace(sparse_model(("a", "b")), left_out=("c",), errors_px=np.full(8, 1.5))
    verdicts = {each.name: each for each in scene_gates(Reconstruction(model, {"board": 1.0, "focus": 1.002}))}
    assert verdicts["all viewpoints placed"].failed and "2 of 3 (left out: c)" in verdicts["all viewpoints placed"].measured
    assert verdicts["points lie where they are seen"].failed
    assert verdicts["scales agree"].verdict == "passed" and verdicts["scales agree"].value == pytest.approx(0.002)
    assert all(each.verdict == "absent" for each in scene_gates(Reconstruction(None, None)))
    assert scales_in({"metres_per_unit": 2.0, "method": "board"}) == {"board": 2.0}


def test_drawings_hold_cameras_points_and_what_is_finite() -> None:
    """Camera b stands 0.1 right of a; a's picture, 0.8 x 0.535 of its distance wide and high, is seen upright: y grows downwards."""
    model = sparse_model(("a", "b</script>"))
    data = scene_of(model)
    first, second = data["cameras"]
    np.testing.assert_allclose(np.subtract(second["centre"], first["centre"]), [0.1, 0.0, 0.0], atol=1e-12)
    corners = np.array(first["corners"]) - first["centre"]
    np.testing.assert_allclose(corners[1] - corners[0], [0.8 * corners[0, 2], 0, 0], atol=1e-12)
    assert corners[3, 1] > corners[0, 1] and len(data["points"]) == 3 * 8 and data["unit"] == "units"
    html = poses_view(model)
    assert html.count("</script>") == 2, "a name cannot end the script"
    drawn = chart(Axes("dB", "slice", "dB", (30.0, 45.0)), [0.0, 1.0, 2.0], {"a<b": [40.0, float("nan"), 42.0], "b": [1.0, 2.0, 3.0]})
    assert drawn.count("<circle") == 5 and "a&lt;b" in drawn
    assert not re.search("nan|inf", drawn)
    assert chart(Axes("t", "x", "y"), [0.0], {"a": [float("nan")]}) == ""
