"""Stacks of which no distance is known: every command works on them, gives what it gives in true metres, and says what is a guess."""

import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from matplotlib.figure import Figure

from capture.merging.preferred_side import PREFERRED
from capture.poses.lens_calibration import write_calibrated
from mrbokeh.images.exr_io import read_exr, write_exr
from mrbokeh.images.image_io import read_image, write_layer
from mrbokeh.images.layer import Layer
from mrbokeh.lens_measuring.fitting.blur_pairs import StackSlices
from mrbokeh.optics.lens_file import lens_to_json, write_lens
from mrbokeh.optics.psf_bank import PsfBank
from mrbokeh.optics.psf_bank_file import read_bank
from mrbokeh.renderers.scatter_reference import ScatterReference
from mrbokeh.stacks.focal_stack import FocalStack, read_focal_stack, write_focal_stack
from mrbokeh.stacks.focal_stack_dataset import read_focal_stack_dataset
from mrbokeh.stacks.focus_places import FocusLookup, parse_focus, slice_names
from mrbokeh.stacks.guessed_metres import (
    POSITION,
    POSITION_ERROR,
    SLICE_POSITION,
    STATED_BEFORE,
    is_lens_guessed,
    metres_line,
    metres_note,
    metres_notes,
)
from tests.compositing.test_composite_command import CAKE
from tests.project.test_user_mistakes import said
from tests.support.card_stack import CARD_PX, LENS, SIZE, make_card_stack
from tests.support.guessed_stack import guessed_twin
from tests.support.left_out_slices import leave_one_out
from tests.support.refusals import refused
from training.export.onnx_export import network_facts_of
from training.fitting.run_folder import load_run

Run = Callable[..., str]
ON_CARD, ON_WALL = "10,24", "60,24"


@pytest.fixture
def run(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> Run:
    """`mrbokeh` with these arguments; what it said."""

    def run(*arguments: object) -> str:
        code, told = said(capsys, monkeypatch, *arguments)
        assert code == 0, told
        return told

    return run


@pytest.fixture(scope="module")
def photographed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return make_card_stack(tmp_path_factory.mktemp("photographed") / "known", 3).folder


@pytest.fixture
def known(photographed: Path, tmp_path: Path) -> FocalStack:
    return read_focal_stack(shutil.copytree(photographed, tmp_path / "scene" / "known"))


@pytest.fixture
def guessed(known: FocalStack, tmp_path: Path) -> FocalStack:
    return guessed_twin(known, tmp_path / "guesses" / "twin")


def test_blur_in_pixels_is_that_of_the_true_metres(known: FocalStack, guessed: FocalStack) -> None:
    assert not read_focal_stack(guessed.folder).metres_known
    for index in range(len(known)):
        np.testing.assert_allclose(guessed.coc_px(index, guessed.depth_m()), known.coc_px(index, known.depth_m()), atol=1e-4)


def test_the_note_names_what_is_guessed_and_the_way_out(known: FocalStack, guessed: FocalStack) -> None:
    assert metres_note(known) == ""
    assert "metres are guessed: no focus distance is stated;" in metres_note(guessed) and "--ruler" in metres_note(guessed)
    assert "\n" not in metres_note(guessed) and metres_notes([known, guessed]) == metres_line(guessed)
    assert "in 2 of the stacks" in metres_notes([guessed, guessed])


# ---- refocus


def test_places_between_slices_and_at_pixels(known: FocalStack) -> None:
    """Slices at 0.5, 0.55 and 0.7 m; the card is at 0.5 m and the wall at 0.7 m."""
    seen = FocusLookup.of(known)
    assert parse_focus("#1", seen) == (0.55,)
    assert parse_focus("#0.5", seen)[0] == pytest.approx(2.0 / (1 / 0.5 + 1 / 0.55))
    assert parse_focus(f"@{ON_CARD},#1,@{ON_WALL},inf", seen) == pytest.approx((0.5, 0.55, 0.7, float("inf")))
    assert parse_focus("#0:#2:3", seen) == pytest.approx((0.5, 2.0 / (1 / 0.5 + 1 / 0.7), 0.7))
    assert parse_focus(f"@{ON_CARD}:@{ON_WALL}:2", seen) == pytest.approx((0.5, 0.7))


@pytest.mark.parametrize(
    ("text", "match"),
    [("#3", "#0 to #2"), ("#-1", "#0 to #2"), ("@500,2", "72 x 48 pixels"), ("#a", "--focus"), ("@1", "--focus"), ("#0,#0", "different")],
)
def test_places_that_are_not_there_are_refused(known: FocalStack, text: str, match: str) -> None:
    refused(match, parse_focus, text, FocusLookup.of(known))
    for place, needed in (("#1", "a focal stack, for a picture has no slices"), ("@1,1", "needs the depth of the picture")):
        refused(needed, parse_focus, place, FocusLookup(LENS))


def test_names_of_slices_close_together_differ() -> None:
    assert slice_names((0.5, 0.7)) == ["slice_0.5000m.exr", "slice_0.7000m.exr"]
    assert slice_names((0.03121, 0.03122)) == ["slice_0.03121m.exr", "slice_0.03122m.exr"]


def test_refocusing_needs_no_metres(known: FocalStack, guessed: FocalStack, tmp_path: Path, run: Run) -> None:
    """The same places in true and in guessed metres give the same pictures; blur is all that counts."""
    places = f"#0.5,#1,@{ON_WALL}"
    run("refocus", known.folder, "--focus", places, "--out", tmp_path / "a", "--renderer", "scatter")
    told = run("refocus", guessed.folder, "--focus", places, "--out", tmp_path / "b", "--renderer", "scatter", "--json")
    assert "metres are guessed" in told and "guessed metres from the lens)" in told and "focus_distances_m" not in told
    truth, made = read_focal_stack(tmp_path / "a"), read_focal_stack(tmp_path / "b")
    for index in range(3):
        np.testing.assert_allclose(made.slice_rgb(index), truth.slice_rgb(index), atol=2e-4)
        np.testing.assert_allclose(made.coc_px(index, made.depth_m()), truth.coc_px(index, truth.depth_m()), atol=0.02)
    assert not made.metres_known and truth.metres_known and "metres are guessed" in metres_note(made)


def test_another_opening_says_how_its_blur_compares(guessed: FocalStack, tmp_path: Path, run: Run) -> None:
    """Whatever the guessed f-number is, half of it blurs twice as much."""
    half = guessed.lens_of(guessed.reference).f_number / 2
    told = run("refocus", guessed.folder, "--focus", "#1", "--f-number", half, "--out", tmp_path / "a", "--renderer", "scatter")
    assert "grows 2.00 times as fast as in the slices" in told


@pytest.mark.parametrize("stated", [False, True])
def test_a_lens_is_a_guess_of_new_slices_as_of_the_old(guessed: FocalStack, tmp_path: Path, run: Run, stated: bool) -> None:
    before = {"lens": lens_to_json(LENS) if stated else None, "camera": None}
    write_focal_stack(replace(guessed, metadata=guessed.metadata | {STATED_BEFORE: before}))
    run("refocus", guessed.folder, "--focus", "#1", "--out", tmp_path / "a", "--renderer", "scatter")
    assert is_lens_guessed(read_focal_stack(tmp_path / "a")) is is_lens_guessed(read_focal_stack(guessed.folder)) is not stated


@pytest.mark.parametrize("command", ["refocus", "transfer"])
def test_a_lens_that_the_user_gives_is_no_guess(command: str, guessed: FocalStack, tmp_path: Path, run: Run) -> None:
    """Its stack is in guessed metres all the same, and nothing can be told of it: its blur does not come from slices."""
    write_lens(tmp_path / "lens.json", LENS)
    out = tmp_path / "made"
    run(command, guessed.folder, "--focus", "#0,#2", "--lens", tmp_path / "lens.json", "--out", out, "--renderer", "scatter")
    made = read_focal_stack(out)
    assert is_lens_guessed(guessed) and not is_lens_guessed(made) and not made.metres_known
    assert "give one known length to the stack that it was made from" in metres_note(made)
    with pytest.raises(AssertionError, match="was made from another stack" if command == "refocus" else "knows its metres"):
        run("capture", "scale", out, "--distance-at", f"{ON_WALL},0.7")


def test_a_slice_left_out_comes_back_as_well_as_in_true_metres(known: FocalStack, guessed: FocalStack) -> None:
    one, other = (next(leave_one_out(stack, ScatterReference(threads=1))) for stack in (known, guessed))
    # The stack was made by this very renderer: what is left is the rounding of guesses.
    assert min(one.with_residuals_db, other.with_residuals_db, other.rendered_db) > 100
    assert other.nearest_slice_db == one.nearest_slice_db < 60


# ---- composite


def card(depth_m: float) -> Layer:
    alpha = np.zeros(SIZE, np.float32)
    alpha[16:32, CARD_PX + 6 : CARD_PX + 26] = 1.0
    return Layer(alpha[..., None] * np.float32([0.1, 0.9, 0.3]), alpha, np.where(alpha > 0, depth_m, np.inf).astype(np.float32))


def test_a_layer_takes_the_blur_of_the_surface_at_its_pixel(known: FocalStack, guessed: FocalStack, tmp_path: Path, run: Run) -> None:
    """A layer rendered at any distance lies on the wall when put there: the truth has it at the wall's true 0.7 m."""
    write_layer(tmp_path / "right.exr", card(0.7), half=False)
    write_layer(tmp_path / "odd.exr", card(12.0), half=False)
    common = ("--slice", 0, "--renderer", "scatter", "--mode", "over", "--out")
    run("composite", known.folder, "--layer", tmp_path / "right.exr", *common, tmp_path / "truth.exr")
    told = run("composite", guessed.folder, "--layer", tmp_path / "odd.exr", "--at-pixel", ON_WALL, *common, tmp_path / "made.exr")
    assert "metres are guessed" in told and "put in at 2 to 2 guessed metres from the lens, 20x16 px" in told
    np.testing.assert_allclose(read_image(tmp_path / "made.exr"), read_image(tmp_path / "truth.exr"), atol=2e-3)
    told = run("composite", guessed.folder, "--layer", tmp_path / "odd.exr", *common, tmp_path / "beside.exr")
    assert "--at-pixel X,Y puts them onto the surface" in told


def test_another_lens_says_how_its_blur_compares_in_a_composite(guessed: FocalStack, tmp_path: Path, run: Run) -> None:
    lens = guessed.lens_of(guessed.reference)
    write_lens(tmp_path / "half.json", replace(lens, f_number=lens.f_number / 2))
    write_layer(tmp_path / "card.exr", card(12.0), half=False)
    common = ("--layer", tmp_path / "card.exr", "--at-pixel", ON_WALL, "--renderer", "scatter", "--mode", "front", "--slice", 0)
    told = run("composite", guessed.folder, *common, "--lens", tmp_path / "half.json", "--out", tmp_path / "a.exr")
    assert "metres are guessed" in told and "grows 2.00 times as fast as in the slices" in told
    assert "times as fast" not in run("composite", guessed.folder, *common, "--out", tmp_path / "b.exr")


def test_all_slices_hold_it_and_its_position_in_blur(guessed: FocalStack, tmp_path: Path, run: Run) -> None:
    write_layer(tmp_path / "odd.exr", card(12.0), half=False)
    arguments = ("--all-slices", "--renderer", "scatter", "--mode", "over", "--out", tmp_path / "made")
    run("composite", guessed.folder, "--layer", tmp_path / "odd.exr", "--at-pixel", ON_CARD, *arguments)
    made = read_focal_stack(tmp_path / "made")
    positions_px = read_exr(made.depth_path)[0].channels[POSITION]
    np.testing.assert_allclose(made.depth_m()[20, CARD_PX + 10], 1.0, rtol=1e-5)  # where the card is, the nearest focus
    np.testing.assert_allclose(positions_px[20, CARD_PX + 10], positions_px[24, 10], rtol=1e-5)
    assert not made.metres_known


@pytest.mark.parametrize(("height", "rows_px"), [(("--height", "24px"), 24), ((), SIZE[0] / 4)])
def test_objects_are_sized_in_pixels(guessed: FocalStack, tmp_path: Path, run: Run, height: tuple[str, ...], rows_px: float) -> None:
    """Seen level, so that its height in the picture is its own; without a size it takes a quarter of the picture."""
    arguments = ("--slice", 2, "--object", CAKE, "--at-pixel", "50,40", "--pitch", 0, *height, "--renderer", "scatter", "--mode", "front")
    run("composite", guessed.folder, *arguments, "--out", tmp_path / "made.exr", "--save-deep", tmp_path / "sharp.exr")
    alpha = read_exr(tmp_path / "made.exr")[0].channels["sharp.A"].astype(np.float32)
    rows = np.flatnonzero((alpha > 0.5).any(axis=1))
    assert np.ptp(rows) + 1 == pytest.approx(rows_px, abs=3.5)  # its round foot reaches below the pixel it stands on
    assert rows.max() == pytest.approx(40, abs=3)


def test_heights_that_are_none_are_refused(guessed: FocalStack, tmp_path: Path, run: Run) -> None:
    for height in ("px", "-3px", "0", "tall"):
        with pytest.raises(AssertionError, match=r"--height: expected metres above 0 such as 0\.1, or pixels such as 120px"):
            run(
                "composite",
                guessed.folder,
                "--slice",
                0,
                "--object",
                CAKE,
                "--at-pixel",
                "9,9",
                "--height",
                height,
                "--out",
                tmp_path / "a.png",
            )


# ---- transfer, lens fit, data sets, training


def test_transfer_takes_a_stack_and_its_places(known: FocalStack, guessed: FocalStack, tmp_path: Path, run: Run) -> None:
    """Through the stack's own lens it is what refocusing renders."""
    write_lens(tmp_path / "lens.json", LENS)
    common = ("--lens", tmp_path / "lens.json", "--renderer", "scatter", "--focus", "#1", "--out")
    run("transfer", known.folder, *common, tmp_path / "a.exr")
    np.testing.assert_allclose(read_image(tmp_path / "a.exr"), known.slice_rgb(1), rtol=2e-3, atol=1e-3)
    told = run("transfer", guessed.folder, *common, tmp_path / "b.exr")
    assert "metres are guessed" in told and "of the stack" in told
    told = run(
        "transfer",
        guessed.folder / "all_in_focus.exr",
        "--depth",
        guessed.depth_path,
        *common[:4],
        "--focus",
        1.2,
        "--out",
        tmp_path / "c.exr",
    )
    assert "metres are guessed" in told


def test_fits_of_a_lens_see_the_same_blur(known: FocalStack, guessed: FocalStack) -> None:
    """All that `lens fit` takes from a stack: pictures, signed diameters, and where both are known."""
    one, other = StackSlices.of([known]), StackSlices.of([guessed])
    for number in range(len(one)):
        np.testing.assert_allclose(other.view(number).coc_px, one.view(number).coc_px, atol=1e-4)
        np.testing.assert_array_equal(other.view(number).known, one.view(number).known)


def test_a_lens_is_fitted_in_pixels(guessed: FocalStack, tmp_path: Path, run: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    """The sheet of kernels, which takes most of the time, is drawn in tests/optics."""
    drawn = list[PsfBank]()
    monkeypatch.setattr("mrbokeh.figures.psf_bank_drawing.draw_bank", lambda bank: (drawn.append(bank), Figure((1, 1)))[1])
    told = run("lens", "fit", guessed.folder, "--out", tmp_path / "bank", "--regions", "1x1", "--diameters", 8, "--pixels", 4000)
    assert "metres are guessed" in told and "needs no metres" in told
    kept = read_bank(tmp_path / "bank")
    assert [each.name for each in kept.axes] == [each.name for each in drawn[0].axes] == ["diameter_px"]
    assert len(kept.kernels) == len(drawn[0].kernels) > 0
    assert (tmp_path / "bank" / "kernels.png").is_file() and (tmp_path / "bank" / "evidence.png").is_file()


def test_data_sets_record_it_and_networks_train(
    known: FocalStack, guessed: FocalStack, tmp_path: Path, run: Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("training.fitting.record.draw_curve", lambda _folder, _curve: "<svg></svg>")
    guessed_twin(make_card_stack(tmp_path / "other", 4), guessed.folder.parent / "second")
    told = run("capture", "dataset", guessed.folder.parent, "--out", tmp_path / "set", "--licence", "CC0", "--renderer", "scatter")
    assert "metres are guessed" in told
    dataset = read_focal_stack_dataset(tmp_path / "set")
    assert dataset.metadata["metres_guessed"] == ["guesses/second", "guesses/twin"]
    assert dataset.largest_coc_px == pytest.approx(max(float(np.abs(known.coc_px(i, known.depth_m())).max()) for i in range(3)), rel=1e-3)
    training = ("--preset", "demo", "--epochs", 1, "--threads", 1, "--set", "sheets=false", "--set", "crop_px=0")
    assert "metres are guessed" in run("train", "fit", tmp_path / "set", *training, "--out", tmp_path / "run")
    assert "metres are guessed" in run(
        "train",
        "evaluate",
        tmp_path / "run",
        tmp_path / "set",
        "--renderer",
        "none",
        "--no-reference",
        "--pull",
        0,
        "--out",
        tmp_path / "eval",
    )
    network, settings, facts = load_run(tmp_path / "run")
    assert network_facts_of(network, settings.network, facts).lens_guessed


# ---- metres


def true_m(stack: FocalStack, known: FocalStack) -> float:
    """By how much the focus distances differ from the true ones at most, as a share."""
    return float(np.abs(np.array(stack.focus_distances_m, float) / np.array(known.focus_distances_m, float) - 1.0).max())


def pixel_length_m(known: FocalStack, pixels: float, depth_m: float) -> float:
    return pixels / known.lens_of(known.reference).focal_px(SIZE[1]) * depth_m


def test_two_distances_give_all_metres(known: FocalStack, guessed: FocalStack, run: Run) -> None:
    told = run("capture", "scale", guessed.folder, "--distance-at", f"{ON_CARD},0.5", "--distance-at", f"{ON_WALL},0.7")
    made = read_focal_stack(guessed.folder)
    assert made.metres_known and "focused from 0.5 m to 0.7 m" in told
    assert true_m(made, known) < 1e-4
    np.testing.assert_allclose(made.depth_m(), known.depth_m(), rtol=1e-4)
    for index in range(3):
        np.testing.assert_allclose(made.coc_px(index, made.depth_m()), known.coc_px(index, known.depth_m()), atol=1e-3)


def test_two_lengths_at_two_depths_do_as_well(known: FocalStack, guessed: FocalStack, run: Run) -> None:
    near, far = (pixel_length_m(known, 20, depth_m) for depth_m in (0.5, 0.7))
    run("capture", "scale", guessed.folder, "--ruler", f"4,24,24,24,{near}", "--ruler", f"40,10,40,30,{far}")
    assert true_m(read_focal_stack(guessed.folder), known) < 1e-3


def test_one_length_with_a_stated_lens_gives_all_metres(known: FocalStack, tmp_path: Path, run: Run) -> None:
    """A length from the card to the wall, across the depth that is still unknown."""
    twin = guessed_twin(known, tmp_path / "twin", lens_stated=True)
    assert true_m(twin, known) > 0.2
    points = [
        np.array([(x + 0.0 - SIZE[1] / 2), 0.0, focal := known.lens_of(0).focal_px(SIZE[1])]) / focal * z for x, z in ((10, 0.5), (60, 0.7))
    ]
    run("capture", "scale", twin.folder, "--ruler", f"10,24,60,24,{np.linalg.norm(points[0] - points[1])}")
    made = read_focal_stack(twin.folder)
    assert true_m(made, known) < 1e-3 and made.lens is not None and known.lens is not None
    assert made.lens.focal_length_mm == known.lens.focal_length_mm and metres_note(made) == ""


def test_one_length_across_two_depths_scales_the_world_as_well(guessed: FocalStack, run: Run) -> None:
    """One fact cannot tell two unknowns: a macro stack came out with all its slices within half a millimetre."""
    run("capture", "scale", guessed.folder, "--ruler", "10,24,60,24,0.003")
    distances_m = [each or 0.0 for each in read_focal_stack(guessed.folder).focus_distances_m]
    assert distances_m[2] / distances_m[0] == pytest.approx(2.0, rel=1e-4) and distances_m[0] < 0.01


def test_one_length_alone_scales_the_world_and_says_so(known: FocalStack, guessed: FocalStack, run: Run) -> None:
    """A coin of 20 px is 3 mm: the wall is near, the far is still twice as far as the near, and all blur is as it was."""
    told = run("capture", "scale", guessed.folder, "--ruler", "40,24,60,24,0.003")
    made = read_focal_stack(guessed.folder)
    assert made.camera is not None and made.lens is not None
    wall_m = 0.003 / 20 * made.camera.focal_px[0]
    np.testing.assert_allclose(made.depth_m()[24, 50], wall_m, rtol=1e-4)
    assert made.focus_distances_m[2] == pytest.approx(wall_m, rel=1e-4)
    assert made.focus_distances_m[0] == pytest.approx(wall_m / 2, rel=1e-4)
    assert made.metres_known and "still guessed: how deep the scene is" in told and "field of view" in metres_note(made)
    for index in range(3):
        np.testing.assert_allclose(made.coc_px(index, made.depth_m()), known.coc_px(index, known.depth_m()), atol=2e-3)
    assert made.lens.focal_px(72) == pytest.approx(guessed.lens.focal_px(72), rel=1e-6) if guessed.lens else False


def test_facts_add_up_over_calls_and_can_be_taken_back(known: FocalStack, guessed: FocalStack, run: Run) -> None:
    run("capture", "scale", guessed.folder, "--distance-at", f"{ON_CARD},0.8")
    run("capture", "scale", guessed.folder, "--distance-at", f"{ON_CARD},0.5")
    run("capture", "scale", guessed.folder, "--distance-at", f"{ON_WALL},0.7")
    assert true_m(read_focal_stack(guessed.folder), known) < 1e-4
    run("capture", "scale", guessed.folder, "--distance-at", f"{ON_CARD},1.0", "--overwrite")
    assert read_focal_stack(guessed.folder).focus_distances_m == pytest.approx((1.0, 1.1, 1.4), rel=1e-4)


def test_two_distances_tell_which_end_is_near(known: FocalStack, tmp_path: Path, run: Run) -> None:
    """Blur looks alike on both sides: the twin of a stack taken for one with near and far exchanged."""
    twin = guessed_twin(known, tmp_path / "twin")
    gauge = twin.metadata["metres"]["gauge"] | {"near_first": False, "near_first_sure": False}
    _write_exchanged(replace(twin, metadata=twin.metadata | {"metres": twin.metadata["metres"] | {"gauge": gauge}}))
    assert read_focal_stack(twin.folder).focus_distances_m[0] == pytest.approx(2.0)
    run("capture", "scale", twin.folder, "--distance-at", f"{ON_CARD},0.5", "--distance-at", f"{ON_WALL},0.7")
    made = read_focal_stack(twin.folder)
    assert true_m(made, known) < 1e-4 and made.metadata["metres"]["gauge"]["near_first"] is True
    for index in range(3):
        np.testing.assert_allclose(made.coc_px(index, made.depth_m()), known.coc_px(index, known.depth_m()), atol=1e-3)
    assert "nearest" not in metres_note(made)


def test_near_and_far_are_turned_by_one_word(known: FocalStack, tmp_path: Path, run: Run) -> None:
    """The depth comes out as that of the twin, whose order is right, for what is guessed is put at 1 m to 2 m both times."""
    right = guessed_twin(known, tmp_path / "right")
    wrong = guessed_twin(known, tmp_path / "wrong")
    gauge = wrong.metadata["metres"]["gauge"] | {"near_first": False, "near_first_sure": False}
    _write_exchanged(replace(wrong, metadata=wrong.metadata | {"metres": wrong.metadata["metres"] | {"gauge": gauge}}))
    assert "the last slice nearest" in metres_note(read_focal_stack(wrong.folder))
    assert "--nearest first" in metres_note(read_focal_stack(wrong.folder))
    told = run("capture", "scale", wrong.folder, "--nearest", "first")
    assert "the first slice is the nearest" in told and (wrong.folder / "depth.png").is_file()
    made = read_focal_stack(wrong.folder)
    assert made.focus_distances_m == pytest.approx(right.focus_distances_m, rel=1e-5) and not made.metres_known
    np.testing.assert_allclose(made.depth_m(), right.depth_m(), rtol=1e-5)
    for index in range(3):
        np.testing.assert_allclose(made.coc_px(index, made.depth_m()), known.coc_px(index, known.depth_m()), atol=2e-3)
    assert "nearest" not in metres_note(made).replace("the nearest plane", "")
    for turn in ("first", "last", "first"):
        run("capture", "scale", wrong.folder, "--nearest", turn)
    again = read_focal_stack(wrong.folder)
    np.testing.assert_allclose(again.depth_m(), made.depth_m(), rtol=1e-5)
    assert again.lens is not None and made.lens is not None
    assert again.lens.focal_length_mm == pytest.approx(made.lens.focal_length_mm, rel=1e-6)


def test_what_was_preferred_turns_with_near_and_far(guessed: FocalStack, run: Run) -> None:
    record = {"side": "near", "share": 0.1, "first_is_near": True, "sure": False}
    positions = tuple(replace(each, metadata=each.metadata | {SLICE_POSITION: 3.0}) for each in guessed.slices)
    write_focal_stack(replace(guessed, slices=positions, metadata=guessed.metadata | {PREFERRED: record}))
    for nearest, side in (("first", "near"), ("last", "far")):
        run("capture", "scale", guessed.folder, "--nearest", nearest)
        made = read_focal_stack(guessed.folder)
        assert made.metadata[PREFERRED] == record | {"side": side, "first_is_near": side == "near", "sure": True}
    assert made.slices[0].metadata[SLICE_POSITION] == -3.0


def test_calibration_against_poses_turns_what_merging_guessed_wrong(known: FocalStack, guessed: FocalStack) -> None:
    """Its depth is made from the focus index, which is that of the first slice everywhere in this stack."""
    record = {"side": "near", "share": 0.1, "first_is_near": True, "sure": False}
    before = replace(guessed, metadata=guessed.metadata | {PREFERRED: record})
    positions_px = read_exr(before.depth_path)[0].channels[POSITION]
    distances_m = known.focus_distances_m[::-1]
    slices = [
        replace(each, focus_distance_m=distance_m, metadata=each.metadata | {SLICE_POSITION: 2.0})
        for each, distance_m in zip(before.slices, distances_m, strict=True)
    ]
    facts = {"known": True, "why": "metres rest on the camera poses"}
    write_calibrated(before, replace(before, slices=tuple(slices), metadata=before.metadata | {"metres": facts}))
    made = read_focal_stack(before.folder)
    np.testing.assert_allclose(made.depth_m(), 0.7, rtol=1e-6)
    np.testing.assert_array_equal(read_exr(made.depth_path)[0].channels[POSITION], -positions_px)
    assert [each.metadata[SLICE_POSITION] for each in made.slices] == [-2.0] * 3
    assert made.metadata[PREFERRED]["side"] == "far"
    assert (made.folder / "depth.png").is_file() and (made.folder / "merge.png").is_file()


def test_turning_keeps_a_length_that_was_told(known: FocalStack, tmp_path: Path, run: Run) -> None:
    twin = guessed_twin(known, tmp_path / "twin")
    run("capture", "scale", twin.folder, "--distance-at", f"{ON_WALL},0.7")
    run("capture", "scale", twin.folder, "--nearest", "last")
    made = read_focal_stack(twin.folder)
    assert made.depth_m()[24, 50] == pytest.approx(0.7, rel=1e-4)
    assert made.focus_distances_m[0] > made.focus_distances_m[2]


def test_who_states_distances_needs_no_direction(
    known: FocalStack, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    code, told = said(capsys, monkeypatch, "capture", "scale", known.folder, "--nearest", "last")
    assert code == 2 and "--nearest is for stacks that have to guess it" in told


def _write_exchanged(stack: FocalStack) -> None:
    """Nearness mirrored in the middle of 0.5 and 1 dioptres: what was at 1 m is taken to be at 2 m."""
    slices = tuple(replace(each, focus_distance_m=1.0 / (1.5 - 1.0 / float(each.focus_distance_m or 0))) for each in stack.slices)
    part = read_exr(stack.depth_path)[0]
    mirrored_m = (1.0 / (1.5 - 1.0 / part.channels["Z"])).astype(np.float32)
    write_exr(stack.depth_path, replace(part, channels=dict(part.channels) | {"Z": mirrored_m}))
    write_focal_stack(replace(stack, slices=slices))


def test_contradictions_are_told(guessed: FocalStack, run: Run) -> None:
    told = run("capture", "scale", guessed.folder, "--distance-at", f"{ON_CARD},0.5", "--distance-at", "20,30,1.5")
    assert "warning: what was told disagrees" in told


def test_what_cannot_be_told_is_refused(known: FocalStack, guessed: FocalStack, run: Run) -> None:
    for folder, arguments, match in (
        (known.folder, ("--distance-at", "9,9,0.6"), "knows its metres from its focus distances"),
        (guessed.folder, ("--ruler", "9,9,9,9,0.6"), "--ruler: expected"),
        (guessed.folder, ("--ruler", "9,9,20,9"), "--ruler: expected"),
        (guessed.folder, ("--distance-at", "9,9,-1"), "--distance-at: expected"),
        (guessed.folder, ("--distance-at", "99,9,1"), "outside the picture of 72x48"),
        (guessed.folder, ("--distance-at", "9,9,1", "--distance", "a,b,1"), "--distance is for a whole scene"),
        (guessed.folder, ("--distance-at", "9,9,1", "--square", 30, "--marker", 22), "--square, --marker is for a whole scene"),
        (guessed.folder, ("--nearest", "last", "--no-calibrate"), "--no-calibrate is for a whole scene"),
        (guessed.folder, ("--nearest", "last", "--overwrite"), "--nearest works without it"),
    ):
        with pytest.raises(AssertionError, match=match):
            run("capture", "scale", folder, *arguments)


def test_depth_counts_where_slices_tell_it(known: FocalStack, guessed: FocalStack, run: Run) -> None:
    """By its confidence, or by the error of its position: 10 px of 14 that the slices span is none."""
    for error_px, tells in ((10.0, False), (0.2, True)):
        part = read_exr(guessed.depth_path)[0]
        unsure = {"confidence": np.zeros(SIZE, np.float32), POSITION_ERROR: np.full(SIZE, error_px, np.float32)}
        write_exr(guessed.depth_path, replace(part, channels=dict(part.channels) | unsure))
        if tells:
            run("capture", "scale", guessed.folder, "--distance-at", f"{ON_CARD},0.5", "--distance-at", f"{ON_WALL},0.7")
            assert true_m(read_focal_stack(guessed.folder), known) < 1e-4
        else:
            with pytest.raises(AssertionError, match="choose a place with texture"):
                run("capture", "scale", guessed.folder, "--distance-at", "9,9,1")


def test_a_stated_focus_counts_as_a_fact(known: FocalStack, guessed: FocalStack, run: Run) -> None:
    """The first slice states 0.5 m, and merging scaled its guess to that; one distance to the wall gives the rest."""
    factor = 0.5
    slices = tuple(
        replace(
            each,
            focus_distance_m=float(each.focus_distance_m or 0) * factor,
            metadata=each.metadata
            | {"px_per_dioptre": each.metadata["px_per_dioptre"] * factor}
            | ({"stated_focus_distance_m": 0.5} if index == 0 else {}),
        )
        for index, each in enumerate(guessed.slices)
    )
    part = read_exr(guessed.depth_path)[0]
    write_exr(guessed.depth_path, replace(part, channels=dict(part.channels) | {"Z": part.channels["Z"] * np.float32(factor)}))
    write_focal_stack(replace(guessed, slices=slices))
    run("capture", "scale", guessed.folder, "--distance-at", f"{ON_WALL},0.7")
    assert true_m(read_focal_stack(guessed.folder), known) < 1e-3


@pytest.mark.parametrize("across", [False, True])
def test_a_slice_stated_at_infinity_stays_there_and_one_fact_gives_the_rest(tmp_path: Path, run: Run, across: bool) -> None:
    """The fact: how far the wall is, or a length from the card to the wall."""
    known = make_card_stack(tmp_path / "known", 3, (0.5, 0.7, float("inf")))
    twin = guessed_twin(known, tmp_path / "twin")
    write_focal_stack(_with_farthest_at_infinity(twin))
    points = [np.array([(x - SIZE[1] / 2) / twin_focal_px(twin), 0.0, 1.0]) * z for x, z in ((10, 0.5), (60, 0.7))]
    ruler = ("--ruler", f"{ON_CARD},{ON_WALL},{np.linalg.norm(points[0] - points[1])}")
    told = run("capture", "scale", twin.folder, *(ruler if across else ("--distance-at", f"{ON_WALL},0.7")))
    made = read_focal_stack(twin.folder)
    assert made.focus_distances_m == pytest.approx((0.5, 0.7, float("inf")), rel=1e-4)
    assert made.metres_known and "how deep the scene is" not in told
    for index in range(3):
        np.testing.assert_allclose(made.coc_px(index, made.depth_m()), known.coc_px(index, known.depth_m()), atol=1e-3)
    with pytest.raises(AssertionError, match="which slice is nearest is already known"):
        run("capture", "scale", twin.folder, "--nearest", "last")


def twin_focal_px(twin: FocalStack) -> float:
    assert twin.camera is not None
    return twin.camera.focal_px[0]


def _with_farthest_at_infinity(twin: FocalStack) -> FocalStack:
    """A twin whose last slice, which it takes to be focused at 2 m, states infinity: all is half a dioptre farther."""
    part = read_exr(twin.depth_path)[0]
    depth_m = (1.0 / (1.0 / part.channels["Z"] - 0.5)).astype(np.float32)
    write_exr(twin.depth_path, replace(part, channels=dict(part.channels) | {"Z": depth_m}))
    slices = tuple(replace(each, focus_distance_m=1.0 / (1.0 / float(each.focus_distance_m or 0.0) - 0.5)) for each in twin.slices[:2])
    last = twin.slices[2]
    last = replace(last, focus_distance_m=float("inf"), metadata=last.metadata | {"stated_focus_distance_m": "inf"})
    gauge = twin.metadata["metres"]["gauge"] | {"offset_dioptres": 0.0, "offset_from": "distances"}
    facts = twin.metadata["metres"] | {"gauge": gauge}
    return replace(twin, slices=(*slices, last), metadata=twin.metadata | {"metres": facts})
