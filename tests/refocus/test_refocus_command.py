"""New slices of a focal stack, held against traced ones and against slices that were left out; one virtual scene in a whole stack."""

from dataclasses import replace
from functools import partial
from pathlib import Path

import cv2
import numpy as np
import pytest

from mrbokeh.commands.refocus import app
from mrbokeh.compositing.over import OverPhotograph
from mrbokeh.compositing.plate import plate_of
from mrbokeh.compositing.stack_compositing import composite_stack
from mrbokeh.images.camera_rgb import read_camera_rgb, write_camera_rgb
from mrbokeh.images.exr_io import read_exr
from mrbokeh.images.image_metrics import psnr
from mrbokeh.images.layer import Layer
from mrbokeh.optics.lens_file import write_lens
from mrbokeh.refocus import Refocusing, lens_at
from mrbokeh.renderers.onnx_network import OnnxNetwork
from mrbokeh.renderers.polygon.polygon_differences import PolygonDifferences
from mrbokeh.renderers.scatter_reference import ScatterReference
from mrbokeh.stacks.focal_stack import FocalStack, Slice, read_focal_stack, write_focal_stack
from mrbokeh.stacks.focus_places import FocusLookup, parse_focus
from tests.support.card_stack import CARD_PX, LENS, SIZE, make_card_stack
from tests.support.command_line import printed_by
from tests.support.left_out_slices import leave_one_out
from tests.support.refusals import refused
from tests.support.renderer_banks import bank_folder

BETWEEN_M = 0.52


def card_stack(folder: Path) -> FocalStack:
    return make_card_stack(folder, 3)


run = partial(printed_by, app)


def test_a_captured_focus_gives_the_captured_slice_and_others_what_the_lens_gives(tmp_path: Path) -> None:
    stack = card_stack(tmp_path / "stack")
    found = Refocusing(stack, ScatterReference(threads=1)).slice_at(0.55)
    np.testing.assert_array_equal(found, stack.slice_rgb(1))
    # The stack was made by this very renderer and lens, so that nothing is left for residuals and truth is exact.
    way = Refocusing(stack, ScatterReference(threads=1))
    for focus_m in (BETWEEN_M, 0.45, float("inf")):
        truth = make_card_stack(tmp_path / f"truth_{focus_m}", 3, (focus_m,)).slice_rgb(0)
        np.testing.assert_allclose(way.slice_at(focus_m), truth, atol=2e-5)
    wide = replace(LENS, f_number=LENS.f_number / 2)
    way = Refocusing(stack, ScatterReference(threads=1), wide)
    assert way.lens_at(0.5).coc_px_per_dioptre(SIZE[1]) == pytest.approx(2 * LENS.focused_at(0.5).coc_px_per_dioptre(SIZE[1]))
    np.testing.assert_array_equal(way.slice_at(0.5), way.rendered(0.5))


def test_the_lens_and_the_focus_may_be_told_by_facts_and_by_a_pixel(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    stack = card_stack(tmp_path / "stack")
    wide = replace(stack.lens_of(stack.reference), f_number=LENS.f_number / 2, sensor_width_mm=2 * LENS.sensor_width_mm)
    write_lens(tmp_path / "wide.json", wide)
    facts = ("--f-number", wide.f_number, "--sensor-width", wide.sensor_width_mm)
    run(stack.folder, "--focus", "@5,5", "--lens", tmp_path / "wide.json", "--out", tmp_path / "by_file")
    run(stack.folder, "--focus-at", "5,5,2", *facts, "--out", tmp_path / "by_facts")
    by_file, by_facts = (read_focal_stack(tmp_path / name) for name in ("by_file", "by_facts"))
    assert by_facts.focus_distances_m == pytest.approx(by_file.focus_distances_m)
    asked = [[stack.metadata["refocused"].get(name) for name in ("focus", "focus_at")] for stack in (by_file, by_facts)]
    assert asked == [["@5,5", None], [None, "5,5,2"]], "what was asked for stands in stack.json"
    np.testing.assert_allclose(by_facts.slice_rgb(0), by_file.slice_rgb(0), atol=1e-5)
    refused("where to focus", run, stack.folder, "--out", tmp_path / "no")
    monkeypatch.setattr("mrbokeh.renderers.choose.make_renderer", lambda _, **__: object.__new__(OnnxNetwork))
    refused("a network blurs as the lens", run, stack.folder, "--focus", "1", *facts, "--renderer", "my.onnx", "--out", tmp_path / "no")


def test_a_bank_is_a_lens_and_as_renderer_takes_the_stacks_own(tmp_path: Path) -> None:
    stack = card_stack(tmp_path / "stack")
    bank = bank_folder(tmp_path / "bank", stack.lens_of(stack.reference), 40.0)
    exact = Refocusing(stack, ScatterReference(threads=1)).rendered(BETWEEN_M)
    for name, way in (("lens", ("--lens", bank)), ("renderer", ("--renderer", bank, "--no-residuals"))):
        run(stack.folder, "--focus", BETWEEN_M, *way, "--out", tmp_path / name)
        assert psnr(read_focal_stack(tmp_path / name).slice_rgb(0), exact) > 38.0


def test_nothing_pops_where_a_focus_pull_passes_a_captured_slice(tmp_path: Path) -> None:
    """The slice in the middle is 3 % brighter than its lens would make it. With residuals its neighbourhood is too; without, nothing is."""
    stack = card_stack(tmp_path / "stack")
    brighter = (stack.slice_rgb(1) * np.float32(1.03)).astype(np.float32)
    write_camera_rgb(stack.folder / stack.slices[1].path, brighter, None, half=False)
    for residuals, most in ((True, 0.02), (False, 0.002)):
        way = Refocusing(stack, ScatterReference(threads=1), residuals=residuals)
        at, beside = way.slice_at(0.55), way.slice_at(0.5502)
        dim = at.max(axis=2) < 0.9
        assert np.abs(at - beside)[dim].mean() < most
    assert np.abs(Refocusing(stack, ScatterReference(threads=1), residuals=False).slice_at(0.55) - stack.slice_rgb(1)).mean() > 0.005


def test_scale_and_f_number_go_over_between_slices(tmp_path: Path) -> None:
    """Registration enlarged the last slice by 4 %, so that its blur is 4 % larger; half way in dioptres it is half of that."""
    stack = card_stack(tmp_path / "stack")
    scaled = replace(stack, slices=(*stack.slices[:2], replace(stack.slices[2], scale=1.04)))
    ends = [1 / each for each in (0.55, 0.7)]
    middle = lens_at(scaled, 2.0 / sum(ends))
    assert LENS.sensor_width_mm / middle.sensor_width_mm == pytest.approx(2 / (1 + 1 / 1.04), rel=1e-6)
    assert lens_at(scaled, 0.7).coc_px_per_dioptre(72) == pytest.approx(scaled.coc_px_per_dioptre(2, 72), rel=1e-6)


def test_residuals_carry_what_the_lens_model_misses(tmp_path: Path) -> None:
    """Slices of a lens of another shape and 25 % more blur than the stack states; light is moderate, as residuals leave lights out."""
    stack = card_stack(tmp_path / "stack")
    other = replace(LENS, f_number=LENS.f_number / 1.25)
    sharp = np.minimum(stack.all_in_focus(), 0.6)
    distances = (0.5, 0.535, 0.575, 0.62, 0.7)
    depth_m = stack.depth_m()
    slices = tuple(Slice(f"other_{index}.exr", distance) for index, distance in enumerate(distances))
    for each in slices:
        lens = other.focused_at(float(each.focus_distance_m or 0))
        blurred = ScatterReference(threads=1).render([Layer(sharp, np.ones_like(depth_m), depth_m)], lens).rgb
        write_camera_rgb(stack.folder / each.path, blurred, None, half=False)
    write_camera_rgb(stack.all_in_focus_path, sharp, None, half=False)
    changed = replace(stack, slices=slices)
    found = list(leave_one_out(changed, ScatterReference(threads=1)))
    assert [each.index for each in found] == [3, 2, 1]
    for left_out in found:
        assert left_out.with_residuals_db > left_out.rendered_db + 1.0
        assert left_out.with_residuals_db > left_out.nearest_slice_db


def test_residuals_hold_the_light_that_an_all_in_focus_picture_lost(tmp_path: Path) -> None:
    """Lights of radiance 20 that the all-in-focus picture has clipped to 1: their discs are in the slices, 1.8 px of blur apart."""
    stack = card_stack(tmp_path / "stack")
    distances = tuple(float(each) for each in 1.0 / np.linspace(1 / 0.5, 1 / 0.56, 4))
    captured = make_card_stack(tmp_path / "close", 3, distances)
    write_camera_rgb(captured.all_in_focus_path, np.minimum(stack.all_in_focus(), 1.0), None, half=False)
    for left_out in leave_one_out(captured, ScatterReference(threads=1)):
        assert left_out.with_residuals_db > left_out.rendered_db + 6.0


def test_pixels_beside_full_photosites_are_believed_as_far_as_they_were_measured(tmp_path: Path) -> None:
    """The stack is cut at 0.8, its masks reach 3 px farther than what is full, and its all-in-focus picture is a quarter too bright."""
    stack = card_stack(tmp_path / "stack")
    for each in stack.slices:
        cut = np.minimum(read_camera_rgb(stack.folder / each.path), np.float32(0.8))
        mask = cv2.dilate((cut.max(axis=2) >= 0.8).astype(np.uint8), np.ones((7, 7), np.uint8)) > 0
        write_camera_rgb(stack.folder / each.path, cut, None, saturated=mask, half=False)
    write_camera_rgb(stack.all_in_focus_path, 1.25 * stack.all_in_focus(), None, half=False)
    slices = tuple(replace(each, metadata={"saturation_level": 0.8}) for each in stack.slices)
    way = Refocusing(replace(stack, slices=slices), ScatterReference(threads=1))
    beside, captured, marked = way.slice_at(0.5502), stack.slice_rgb(1), stack.slice_masks(1).saturated
    peak = captured.max(axis=2)
    measured, full = marked & (peak < 0.85 * 0.8), peak >= 0.8
    assert measured.sum() > 100 and full.sum() > 20
    assert np.abs(way.rendered(0.5502) - captured)[measured].mean() > 0.05
    assert np.abs(beside - captured)[measured].max() < 0.01 and (beside[full] > captured[full] - 0.01).all()


@pytest.mark.slow
def test_residuals_gain_on_a_traced_stack(tmp_path: Path) -> None:
    """Path-traced slices with noise, left out one by one: at least 0.5 dB more with residuals in each, and far above the nearest slice."""
    from tests.support.traced_focal_stack import traced, write_stack

    for each in leave_one_out(write_stack(tmp_path / "traced", traced()), PolygonDifferences(threads=1)):
        assert each.rendered_db > 38.0 and each.with_residuals_db > each.rendered_db + 0.5
        assert each.rendered_db > each.nearest_slice_db + 6.0


def test_the_command_writes_a_focal_stack(tmp_path: Path) -> None:
    stack = card_stack(tmp_path / "stack")
    refused(f"give {stack.folder}, which lies in it", run, tmp_path, "--focus", "0.52", "--out", tmp_path / "new")
    words = ("--out", tmp_path / "new", "--renderer", "scatter", "--sheet", tmp_path / "sheet.png")
    said = run(stack.folder, "--focus", "0.52,0.55,inf", *words)
    # Focused at infinity the lens blurs the card and the wall, at 0.5 and 0.7 m, by more than 4 px.
    assert said.count("nothing is sharp at") == 1 and "nothing is sharp at inf m" in said
    made = read_focal_stack(tmp_path / "new")
    assert made.focus_distances_m == (0.52, 0.55, float("inf")) and made.merged
    np.testing.assert_array_equal(made.slice_rgb(1), stack.slice_rgb(1))
    np.testing.assert_array_equal(made.all_in_focus(), stack.all_in_focus())
    np.testing.assert_array_equal(made.depth_m(), stack.depth_m())
    # The card at 0.5 m lies before the first new slice, the wall at 0.7 m between those at 0.55 m and at infinity.
    np.testing.assert_allclose(made.focus_index()[24, [10, 60]], [0.0, 1.0 + (1 / 0.55 - 1 / 0.7) * 0.55], atol=1e-6)
    assert psnr(made.slice_rgb(0), stack.slice_rgb(0)) < 60 and (tmp_path / "sheet.png").stat().st_size > 500
    refused("--overwrite", run, stack.folder, "--focus", "0.52", "--out", tmp_path / "new")
    run(stack.folder, "--focus", "0.6", "--out", tmp_path / "new", "--overwrite", "--renderer", "scatter")
    assert sorted(each.name for each in (tmp_path / "new").glob("slice*")) == ["slice_0.6000m.exr", "slice_0.6000m.png"]
    other = make_card_stack(tmp_path / "captured", 4)
    refused("not made by refocus", run, stack.folder, "--focus", "0.6", "--out", other.folder, "--overwrite")
    assert len(read_focal_stack(other.folder)) == 3


def test_options_matter(tmp_path: Path) -> None:
    stack = card_stack(tmp_path / "stack")
    write_lens(tmp_path / "long.json", replace(LENS, focal_length_mm=50.0))
    options: dict[str, list] = {
        "plain": [],
        "open": ["--f-number", 1.4],
        "lens": ["--lens", tmp_path / "long.json"],
        "bare": ["--no-residuals"],
    }
    pictures = {}
    # Slices of a lens blurrier than stated, so that there are residuals.
    blurrier = replace(stack, lens=replace(LENS, f_number=3.2))
    write_focal_stack(blurrier)
    for name, more in options.items():
        run(stack.folder, "--focus", "0.52", "--out", tmp_path / name, "--renderer", "scatter", *more)
        pictures[name] = read_focal_stack(tmp_path / name).slice_rgb(0)
    for name in ("open", "lens", "bare"):
        assert np.abs(pictures[name] - pictures["plain"]).max() > 1e-3
    assert read_focal_stack(tmp_path / "open").lens_of(0).f_number == 1.4


def test_an_interrupted_run_goes_on_and_other_settings_start_anew(tmp_path: Path) -> None:
    stack = card_stack(tmp_path / "stack")
    arguments = [stack.folder, "--focus", "0.52,0.6", "--out", tmp_path / "new", "--renderer", "scatter"]
    run(*arguments)
    (tmp_path / "new" / "stack.json").unlink()
    kept = tmp_path / "new" / "slice_0.5200m.exr"
    write_camera_rgb(kept, np.zeros((*SIZE, 3), np.float32), None)
    run(*arguments)
    assert not read_camera_rgb(kept).any()
    (tmp_path / "new" / "stack.json").unlink()
    run(*arguments, "--f-number", 2.0)
    assert read_camera_rgb(kept).any()


@pytest.mark.parametrize("text", ["", "0.8,0.8", "-1", "a", "1:2", "0:2:3"])
def test_odd_distances_are_refused(text: str) -> None:
    refused("--focus", parse_focus, text, FocusLookup(LENS))


def test_distances_evenly_in_dioptres() -> None:
    """From 0.5 m to infinity in five: 2, 1.5, 1, 0.5 and 0 dioptres."""
    assert parse_focus("0.5:inf:5", FocusLookup(LENS)) == pytest.approx((0.5, 2 / 3, 1.0, 2.0, float("inf")))
    assert parse_focus("0.8,inf", FocusLookup(LENS)) == (0.8, float("inf"))
    refused("270 times as far as the farthest slice: a pixel is written @X,Y", parse_focus, "540,600", FocusLookup(LENS, None, (1.0, 2.0)))


# ---- one virtual scene in all slices


def lamp(depth_m: float = 0.6) -> Layer:
    """A square between card and wall, half of it behind the card."""
    alpha = np.zeros(SIZE, np.float32)
    alpha[16:32, CARD_PX - 8 : CARD_PX + 8] = 1.0
    return Layer(alpha[..., None] * np.array([0.1, 0.9, 0.3], np.float32), alpha, np.where(alpha > 0, depth_m, np.inf).astype(np.float32))


def test_a_scene_in_a_stack_has_each_slice_s_blur_and_merges_as_if_it_had_been_there(tmp_path: Path) -> None:
    stack, renderer = card_stack(tmp_path / "stack"), ScatterReference(threads=1)
    made = composite_stack(stack, [lamp()], OverPhotograph(), renderer, tmp_path / "made")
    read = read_focal_stack(tmp_path / "made")
    assert read.focus_distances_m == stack.focus_distances_m == made.focus_distances_m
    for index in range(len(stack)):
        plate = plate_of(stack.slice_rgb(index), stack.lens_of(index), stack.depth_m())
        expected = OverPhotograph().insert(plate, [lamp()], renderer).rgb
        np.testing.assert_allclose(read.slice_rgb(index), expected, atol=2e-5)
    # Depth and all-in-focus picture hold the visible half of the lamp, sharp; what it does not touch is bit for bit the same.
    seen = np.zeros(SIZE, bool)
    seen[16:32, CARD_PX : CARD_PX + 8] = True
    np.testing.assert_array_equal(made.depth_m(), np.where(seen, np.float32(0.6), stack.depth_m()))
    np.testing.assert_allclose(made.all_in_focus()[seen], np.tile(np.float32([0.1, 0.9, 0.3]), (seen.sum(), 1)), atol=1e-6)
    np.testing.assert_array_equal(made.all_in_focus()[~seen], stack.all_in_focus()[~seen])
    assert (made.depth_confidence()[seen] == 1).all()
    # 0.6 m lies between the slices at 0.55 m and 0.7 m, evenly in dioptres.
    expected = 1 + (1 / 0.55 - 1 / 0.6) / (1 / 0.55 - 1 / 0.7)
    assert made.focus_index()[20, CARD_PX + 3] == pytest.approx(expected, abs=1e-3)


def test_in_camera_rgb_untouched_pixels_keep_their_stored_numbers(tmp_path: Path) -> None:
    matrix = ((1.6, -0.5, -0.1), (-0.2, 1.5, -0.3), (0.0, -0.5, 1.5))
    stack = replace(card_stack(tmp_path / "stack"), rec709_from_camera=matrix)
    write_focal_stack(stack)
    for each in stack.slices:
        stored = read_camera_rgb(stack.folder / each.path)
        saturated = stored.max(axis=2) > 5
        write_camera_rgb(stack.folder / each.path, stored, matrix, saturated=saturated, valid=np.ones(SIZE, bool))
    made = composite_stack(stack, [lamp()], OverPhotograph(), ScatterReference(threads=1), tmp_path / "made")
    assert made.rec709_from_camera == matrix
    for index in range(len(stack)):
        before, after = stack.slice_camera_rgb(index), made.slice_camera_rgb(index)
        touched = (before != after).any(axis=2)
        assert 0.03 < touched.mean() < 0.35
        assert read_exr(made.folder / made.slices[index].path)[0].channels["R"].dtype == np.float16
        assert (made.slice_masks(index).saturated == stack.slice_masks(index).saturated).all()
    # In the slice focused nearest to it the lamp has its own colour, through the camera's primaries and half floats.
    np.testing.assert_allclose(made.slice_rgb(1)[24, CARD_PX + 4], [0.1, 0.9, 0.3], atol=4e-3)


def test_layers_may_be_made_for_each_plate(tmp_path: Path) -> None:
    stack, seen = card_stack(tmp_path / "stack"), []

    def staged(plate: object) -> list[Layer]:
        seen.append(plate.lens.focus_distance_m)  # type: ignore[attr-defined]
        return [lamp()]

    composite_stack(stack, staged, OverPhotograph(), ScatterReference(threads=1), tmp_path / "made")
    assert seen == [0.5, 0.55, 0.7, 0.5]
    refused("exists already", composite_stack, stack, staged, OverPhotograph(), ScatterReference(threads=1), tmp_path / "made")
