"""Gates that need no lens: a right merge passes them, each fault of a merge fails its own gate and is shown where it is."""

import json
from collections.abc import Callable
from dataclasses import replace
from functools import cache
from pathlib import Path

import cv2
import numpy as np
import pytest
from jaxtyping import Float32

from capture.commands.process import process_command
from capture.commands.report import report_command
from capture.report.findings import FocusCurve, SliceFindings, StackFindings
from capture.report.gates import GHOSTS, LIGHT, PLACES, SEAMS, SHARP, Gate
from capture.report.picture_sharpness import PictureFindings
from capture.report.registration_check import DisplacementEvidence, NeighbourDisplacement
from capture.report.report_cache import CachedPlace
from capture.report.scene_report import GATE_NAMES, SceneReport, report_scene
from capture.report.stack_gates import picture_gates, stack_gates
from capture.stacks.slice_looks import BLOCK_PX
from mrbokeh.images.camera_rgb import write_camera_rgb
from mrbokeh.images.image_io import read_image
from mrbokeh.stacks.focal_stack import FocalStack, Slice, read_focal_stack, write_focal_stack, write_merged
from mrbokeh.system.atomic_files import write_json
from tests.support.command_line import printed_by
from tests.support.refusals import refused

Rgb = Float32[np.ndarray, "height width 3"]
Made = tuple[list[Rgb], Rgb]
Reported = Callable[[Callable[[], Made]], SceneReport]

WIDTH_PX, HEIGHT_PX = 600, 384
FOCUS_COLUMNS = (75, 225, 375, 525)
BLUR_PER_COLUMN = 1.0 / 150.0
"""Deviation in pixels: half a pixel between two slices, where both are sharp still, and 3 px where another slice is sharp."""
FLAT_FROM_ROW = 216


@cache
def surface() -> Rgb:
    """Texture above FLAT_FROM_ROW, below it a smooth surface with a fiftieth of its contrast. Values lie within 0.1 and 0.7."""
    rng = np.random.default_rng(3)
    grain = cv2.GaussianBlur(rng.standard_normal((HEIGHT_PX, WIDTH_PX, 3)).astype(np.float32), (0, 0), 1.0)
    contrast = np.where(np.arange(HEIGHT_PX) < FLAT_FROM_ROW, 1.0, 0.02)[:, None, None]
    return np.clip(0.4 + 0.3 * contrast * np.clip(grain / grain.std() / 2.5, -1.0, 1.0), 0.1, 0.7).astype(np.float32)


@cache
def slices_of_surface() -> tuple[Rgb, ...]:
    """Focus goes from left to right: the blur of a slice grows with the distance from its column."""
    deviations = np.linspace(0.0, 3.0, 13)
    blurred = np.stack([surface() if each == 0.0 else cv2.GaussianBlur(surface(), (0, 0), each) for each in deviations])
    made = []
    for column in FOCUS_COLUMNS:
        level = np.abs(np.arange(WIDTH_PX) + 0.5 - column) * BLUR_PER_COLUMN / deviations[1]
        below = np.minimum(level.astype(int), len(deviations) - 2)
        share = np.clip(level - below, 0.0, 1.0)[None, :, None].astype(np.float32)
        across = np.arange(WIDTH_PX)
        made.append((1.0 - share) * blurred[below, :, across].swapaxes(0, 1) + share * blurred[below + 1, :, across].swapaxes(0, 1))
    return tuple(each.astype(np.float32) for each in made)


def merged_from(slices: list[Rgb]) -> Rgb:
    """Each column from the slice that is focused nearest to it."""
    return np.take_along_axis(np.stack(slices), focus_index().astype(int)[None, ..., None], axis=0)[0]


def focus_index() -> Float32[np.ndarray, "height width"]:
    nearest = np.abs(np.arange(WIDTH_PX)[:, None] + 0.5 - np.array(FOCUS_COLUMNS)).argmin(axis=1)
    return np.broadcast_to(nearest.astype(np.float32), (HEIGHT_PX, WIDTH_PX)).copy()


def right() -> Made:
    slices = list(slices_of_surface())
    return slices, merged_from(slices)


def lost_disc() -> Made:
    """A disc of 60 px around (130, 110), taken from the slice that is focused farthest from it."""
    slices, picture = right()
    y, x = np.mgrid[:HEIGHT_PX, :WIDTH_PX]
    disc = np.hypot(x - 130, y - 110) < 30
    picture[disc] = slices[3][disc]
    return slices, picture


def jigsaw() -> Made:
    """2 percent more light in every other piece of 8 px of the smooth surface around (300, 300), on the border of slices 1 and 2."""
    slices, picture = right()
    y, x = np.mgrid[:HEIGHT_PX, :WIDTH_PX]
    pieces = ((x // 8 + y // 8) % 2 == 0) & (np.abs(x - 300) < 30) & (np.abs(y - 300) < 60)
    picture[pieces] *= np.float32(1.02)
    return slices, picture


def ghost() -> Made:
    """Something dark of 40 px around (300, 200) that walked away after slice 1, half there in the picture, with a soft border."""
    slices, picture = right()
    y, x = np.mgrid[:HEIGHT_PX, :WIDTH_PX]
    there = cv2.GaussianBlur((np.hypot(x - 300, y - 200) < 20).astype(np.float32), (0, 0), 2.0)[..., None]
    slices[1] = (1.0 - there) * slices[1] + there * np.float32(0.02)
    return slices, ((1.0 - 0.5 * there) * picture + 0.5 * there * np.float32(0.02)).astype(np.float32)


def invented_light() -> Made:
    """A dot of 4.0 at (452, 100), six times the largest value of the slices."""
    slices, picture = right()
    picture[98:103, 450:455] = 4.0
    return slices, picture


def shifted_slice() -> Made:
    """Slice 2 lies 2 px to the right, in the merged picture as well."""
    slices, _ = right()
    slices[2] = np.roll(slices[2], 2, axis=1)
    return slices, merged_from(slices)


def write_made(folder: Path, made: Made) -> FocalStack:
    """A merged stack of a camera about which nothing is known."""
    slices, picture = made
    described = []
    for index, rgb in enumerate(slices):
        path = f"registered/{index:02d}.exr"
        write_camera_rgb(folder / path, rgb, None)
        described.append(Slice(path, None))
    sharpest = focus_index()[: picture.shape[0], : picture.shape[1]]
    write_merged(folder, picture, sharpest, np.ones_like(sharpest), None)
    stack = FocalStack(folder, tuple(described), registered=True, merged=True)
    write_focal_stack(stack)
    return stack


def report_of(folder: Path, made: Made) -> SceneReport:
    write_made(folder / "view_0", made)
    return report_scene(folder)


@pytest.fixture(scope="module")
def reported(tmp_path_factory: pytest.TempPathFactory) -> Reported:
    """The report of a right merge or of one with a fault, made once."""
    return cache(lambda made: report_of(tmp_path_factory.mktemp(made.__name__), made()))


def judged_with(report: SceneReport, **metadata: object) -> dict[str, Gate]:
    """The gates of the picture by name, where merging and retouching say this in the stack, as its file brings it back."""
    findings = report.stacks[0].findings
    stack = replace(findings.stack, metadata=findings.stack.metadata | metadata)
    write_focal_stack(stack)
    read = read_focal_stack(stack.folder)
    write_focal_stack(findings.stack)
    return {each.name: each for each in picture_gates(replace(findings, stack=read))}


def gate(report: SceneReport, name: str) -> Gate:
    return next(each for each in report.gates if each.name == name)


def places(report: SceneReport, name: str) -> list[CachedPlace]:
    return [each for each in report.stacks[0].places if each.gate == name]


def test_a_right_merge_passes_without_any_lens(reported: Reported) -> None:
    """The picture was looked at and no gate failed: passed, with what could not be judged counted."""
    report = reported(right)
    assert not report.failures
    assert {each.name for each in report.gates if each.verdict == "passed"} >= {SHARP.name, SEAMS.name, LIGHT.name, PLACES.name}
    document = json.loads((report.scene / "report.json").read_text())
    assert document["passed"] is True
    assert (document["judged"], document["failed"], document["absent"]) == (10, 0, 11)
    picture = document["stacks"]["view_0"]["picture"]
    assert picture["lost_share"] == 0.0 and picture["flat_detail"] < 1.02
    assert picture["largest"] == pytest.approx(picture["largest_of_slices"], abs=1e-3)
    for pair in document["stacks"]["view_0"]["neighbours"]:
        assert pair["off_px"] < 0.15


@pytest.mark.parametrize(
    ("fault", "rule", "around", "reach_px"),
    [
        (lost_disc, SHARP, (130, 110), 30),
        (jigsaw, SEAMS, (300, 300), 60),
        (ghost, GHOSTS, (300, 200), 30),
        (invented_light, LIGHT, (452, 100), BLOCK_PX),
        (shifted_slice, PLACES, (300, 192), 300),
    ],
)
def test_each_fault_fails_its_gate_and_is_shown(
    fault: Callable[[], Made], rule: object, around: tuple[int, int], reach_px: int, reported: Reported
) -> None:
    """And no other gate; the block that is shown lies where the fault was made."""
    report = reported(fault)
    name = getattr(rule, "name", "")
    assert [each.name for each in report.failures] == [name]
    assert json.loads((report.scene / "report.json").read_text())["passed"] is False
    shown = places(report, name)
    assert shown
    x, y = shown[0].at_px
    assert abs(x + BLOCK_PX / 2 - around[0]) <= reach_px + BLOCK_PX and abs(y + BLOCK_PX / 2 - around[1]) <= reach_px + BLOCK_PX
    assert f"x {x}, y {y}" in (report.scene / "report.html").read_text(encoding="utf-8")


def test_what_was_taken_on_purpose_is_told_where_pictures_are_judged(reported: Reported) -> None:
    """By merging, where something moved, and by hand."""
    retouches = [{"slice": 2, "source": "b.png", "mask": "man.png", "share": 0.1}]
    gates = judged_with(reported(right), ghosts={"before": 0.02, "after": 0.0, "share": 0.125}, retouches=retouches)
    told = "; something moved between the slices: 12.5% of the picture is taken whole from one slice each; retouched: slice 2 by man.png"
    assert gates[SHARP.name].measured.endswith(told) and gates[GHOSTS.name].measured.endswith(told)
    assert "moved" not in gates[SEAMS.name].measured


def test_crops_are_at_100_percent_beside_the_slices_on_both_sides_of_a_seam(reported: Reported) -> None:
    """Of the lost disc: 160 px of the picture around the block, and of the slice that is sharpest there, which is slice 0."""
    shown = places(reported(lost_disc), SHARP.name)[0]
    assert [each.caption for each in shown.pictures] == ["all in focus", "slice 0, the sharpest here"]
    crops = [read_image(each.path) for each in shown.pictures]
    assert all(each.shape == (160, 160, 3) for each in crops)
    inside = np.s_[69:91, 69:91]  # The block lies in the middle of a crop that does not touch the border.
    assert crops[0][inside].std() < 0.6 * crops[1][inside].std()
    # A jigsaw on the border between slices 1 and 2, at column 300.
    captions = [each.caption for each in places(reported(jigsaw), SEAMS.name)[0].pictures]
    assert [each.split(", contrast")[0] for each in captions] == ["all in focus", "slice 1, sharp here", "slice 2, sharp here"]
    assert len({each.split(", contrast")[1] for each in captions}) == 1, "seen with one contrast"


def test_measured_flux_supports_what_no_slice_shows(reported: Reported) -> None:
    """The dot of 4.0: allowed where merging says that discs speak for 4.0, not where they speak for 3.0 or for nothing."""
    for largest, verdict in ((4.0, "passed"), (3.0, "failed")):
        gates = judged_with(reported(invented_light), highlights={"drawn": 1, "largest_supported": largest})
        assert gates[LIGHT.name].verdict == verdict


def test_shifts_and_turns_are_measured_where_there_is_data() -> None:
    """2 px to the right between slices 1 and 2, and back again; 0 between the others, to a tenth of a pixel."""
    evidence = DisplacementEvidence()
    for rgb in shifted_slice()[0]:
        evidence.add(rgb, np.ones((HEIGHT_PX, WIDTH_PX), bool))
    first, second, third = evidence.places()
    assert first.off_px == pytest.approx(0.0, abs=0.15)
    assert second.off_px == pytest.approx(2.0, abs=0.15) and second.exceeds(1.0)
    assert third.off_px == pytest.approx(2.0, abs=0.15)
    assert evidence.places(3.0)[1].off_px == pytest.approx(3.0 * (second.off_px or 0.0)), "in pixels of the stored pictures"
    # 6 mrad about the middle move a pixel at distance r by 0.006 r: the root mean square over the textured rows lies near 1 px.
    middle = np.array([WIDTH_PX / 2 - 0.5, HEIGHT_PX / 2 - 0.5])
    turn = cv2.getRotationMatrix2D(tuple(middle), float(np.rad2deg(0.006)), 1.0)
    turned = cv2.warpAffine(surface(), turn, (WIDTH_PX, HEIGHT_PX), flags=cv2.INTER_CUBIC, borderMode=cv2.BORDER_REFLECT)
    evidence = DisplacementEvidence()
    for rgb in (surface(), turned):
        evidence.add(rgb, np.ones((HEIGHT_PX, WIDTH_PX), bool))
    y, x = np.mgrid[32:FLAT_FROM_ROW, 32 : WIDTH_PX - 32]
    expected_px = 0.006 * np.sqrt(np.mean((x - middle[0]) ** 2 + (y - middle[1]) ** 2))
    assert evidence.places()[0].off_px == pytest.approx(expected_px, rel=0.1)
    # Where the second slice lacks data it shows the first moved by 5 px: not looked at.
    other, usable = surface().copy(), np.ones((HEIGHT_PX, WIDTH_PX), bool)
    other[:, :300], usable[:, :300] = np.roll(surface(), 5, axis=1)[:, :300], False
    evidence = DisplacementEvidence()
    evidence.add(surface(), np.ones_like(usable))
    evidence.add(other, usable)
    assert evidence.places()[0].off_px == pytest.approx(0.0, abs=0.1)


def test_what_is_blurred_in_both_slices_is_seen_to_move_sideways_and_blur_alone_is_not() -> None:
    """A disc at another depth, blurred by 6 and by 9 px (standard deviations), 2 % of the width aside in the second picture."""
    usable, rows, columns = np.ones((HEIGHT_PX, WIDTH_PX), bool), *np.mgrid[:HEIGHT_PX, :WIDTH_PX]

    def seen(moved_px: float, sigma_px: float) -> np.ndarray:
        disc = (np.hypot(rows - HEIGHT_PX / 2, columns - WIDTH_PX / 2 - moved_px) < HEIGHT_PX / 4).astype(np.float32)
        cover = cv2.GaussianBlur(disc, (0, 0), sigma_px)[..., None]
        return ((1.0 - cover) * 0.5 * cv2.GaussianBlur(surface(), (0, 0), 3.0) + cover * 0.9).astype(np.float32)

    for moved_px in (0.0, 0.02 * WIDTH_PX):
        evidence = DisplacementEvidence()
        evidence.add(seen(0.0, 6.0), usable)
        evidence.add(seen(moved_px, 9.0), usable)
        (found,) = evidence.places()
        assert found.parallax_px == pytest.approx(moved_px, abs=0.005 * WIDTH_PX)
    assert np.hypot(found.parallax_place_px[0] - WIDTH_PX / 2, found.parallax_place_px[1] - HEIGHT_PX / 2) < 0.4 * HEIGHT_PX


def test_a_hand_that_moved_sideways_fails_the_gate(tmp_path: Path) -> None:
    """Beyond 0.8 % of 1000 px, though all that is sharp in both slices lies where it should."""
    for parallax_px, verdict in ((7.0, "passed"), (9.0, "failed")):
        pair = NeighbourDisplacement(0, 0.1, 0.05, (100, 100), parallax_px, (300, 200))
        judged = next(each for each in stack_gates(findings_with(tmp_path, [0.1, 0.1], (pair,))) if each.name == PLACES.name)
        assert judged.verdict == verdict and ("up to 9 px apart" in judged.measured) == (verdict == "failed")


SHARP_PICTURE = PictureFindings(0.0, 0.0, 1.0, 0.5, 0.5, (1000, 800))


def findings_with(tmp_path: Path, residuals_px: list[float | None], pairs: tuple[NeighbourDisplacement, ...]) -> StackFindings:
    """Of pictures 1000 px wide."""
    write_json(tmp_path / "registration.json", {"correlations": [1.0] * len(pairs), "residuals_px": residuals_px})
    metadata = {"reference_from_slice": [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0]]}
    slices = tuple(Slice(f"{index}.exr", None, metadata=metadata) for index in range(len(residuals_px)))
    stack = FocalStack(tmp_path, slices, registered=True, merged=True)
    found = tuple(SliceFindings(index, 1.0, 0.0, 1.0) for index in range(len(slices)))
    curve = FocusCurve(np.ones(len(slices)), 1.0, 0.0, 0.0)
    return StackFindings(stack, (500, 400), (1000, 800), found, curve, None, None, SHARP_PICTURE, pairs)


UNKNOWN = float("inf")


@pytest.mark.parametrize(
    ("residuals_px", "pairs", "verdict"),
    [
        pytest.param([0.3, 0.3, 0.2], ((0.2, 0.1), (1.4, 0.3)), "failed", id="apart"),
        pytest.param([0.3, 0.3, 0.2], ((0.2, 0.1), (1.4, 0.6)), "passed", id="by chance"),
        pytest.param([0.3, 4.0, 4.0], ((0.2, 0.1), (5.8, 2.5)), "failed", id="not told by patches"),
        pytest.param([None, None, None], ((5.8, 2.5), (5.8, 2.5)), "absent", id="told by nothing"),
        pytest.param([9.0, 9.0, 9.0], ((0.2, 0.1), (0.3, 0.1)), "passed", id="measured wins"),
        pytest.param([0.3, 4.0, 4.0], ((0.2, 0.1), (None, UNKNOWN)), "failed", id="pairs disagree"),
        pytest.param([4.0, 4.0, 0.5], ((0.2, 0.1), (None, UNKNOWN)), "passed", id="another pair is wrong"),
        pytest.param([None, None, None], ((None, UNKNOWN), (None, UNKNOWN)), "absent", id="by the model alone"),
        pytest.param([0.3, 0.3, None], ((0.2, 0.1), (None, UNKNOWN)), "passed", id="one by the model"),
    ],
)
def test_the_residual_of_the_registration_stands_in_where_nothing_is_sharp_in_both(
    residuals_px: list[float | None], pairs: tuple[tuple[float | None, float], ...], verdict: str, tmp_path: Path
) -> None:
    """0.3% of 1000 px are 3 px. A pair that is wrong raises the residuals of both its slices, so that the smaller counts."""
    measured = tuple(NeighbourDisplacement(first, off_px, error_px, (500, 400)) for first, (off_px, error_px) in enumerate(pairs))
    found = next(each for each in picture_gates(findings_with(tmp_path, residuals_px, measured)) if each.name == PLACES.name)
    assert found.verdict == verdict
    if residuals_px[-1] is None and verdict != "failed":
        assert "no pair of the registration held" in found.measured


def test_a_picture_too_small_to_be_judged_never_passes(tmp_path: Path) -> None:
    """A strip of 600 x 96 has 46 blocks inside its border, of which 14 are flat: nothing failed, and yet nobody has looked for seams."""
    slices, picture = right()
    small = np.s_[160:256]
    report = report_of(tmp_path, ([each[small] for each in slices], picture[small]))
    assert gate(report, SEAMS.name).verdict == "absent"
    assert not report.failures and not report.passed
    assert json.loads((tmp_path / "report.json").read_text())["passed"] is False
    page = (tmp_path / "report.html").read_text(encoding="utf-8")
    assert "Not passed: not all gates of the all-in-focus pictures could be judged." in page and "nobody looked" not in page


@pytest.mark.slow
def test_strict_asks_for_every_gate_and_fails_on_a_fault_whatever_is_allowed(tmp_path: Path) -> None:
    """A right stack without lens: 1 for the gates that could not be judged, 0 where each of them was allowed, 1 where one was not."""
    write_made(tmp_path / "view_0", right())
    plain = printed_by(report_command, tmp_path)
    assert "10 of 21 gates judged, 0 failed, 11 absent: all viewpoints placed" in plain and "--strict" not in plain
    assert "all-in-focus pictures: passed: as sharp as its slices, no seams, no ghosts, no invented light" in plain
    assert "depth and blur, for refocusing and training: passed: " in plain
    assert "absent: all viewpoints placed, points lie where they are seen, scales agree: no reconstruction" in plain
    absences = [each.name for each in report_scene(tmp_path).absences]
    allowed = [option for name in absences for option in ("--allow-absent", name.upper())]
    for options, exit_code in (((), 1), (allowed, 0), (allowed[2:], 1)):
        printed_by(report_command, tmp_path, "--strict", *options, exit_code=exit_code)
    write_made(tmp_path / "view_0", lost_disc())
    assert len(set(GATE_NAMES)) == len(GATE_NAMES) == 21, "names of gates are told apart"
    allowed = [option for name in GATE_NAMES for option in ("--allow-absent", name)]
    failed = printed_by(report_command, tmp_path, "--strict", *allowed, exit_code=1)
    *lines, last = printed_by(report_command, tmp_path).splitlines()
    assert last.startswith(f"{len(report_scene(tmp_path).failures)} gate") and " failed: --strict would make this an error" in last
    assert any(each.startswith(f"  failed: view_0: {SHARP.name}: ") for each in lines), "what spoils the picture is always told"
    line = next(each for each in failed.splitlines() if each.startswith("  failed: "))
    assert f"view_0: {SHARP.name}: " in line and "Look at the crops." in line, "what failed, and what to do"


@pytest.mark.parametrize("command", [report_command, process_command])
def test_a_gate_that_nobody_knows_is_refused_before_the_work(command: Callable[..., None], tmp_path: Path) -> None:
    arguments = [tmp_path, *(["--out", tmp_path / "scene"] if command is process_command else [])]
    refused(r'"no seems".*"no seams"', printed_by, command, *arguments, "--strict", "--allow-absent", "no seems")
    refused("--strict", printed_by, command, *arguments, "--allow-absent", "no seams")
    assert not (tmp_path / "report.html").exists() and not (tmp_path / "scene").exists()
