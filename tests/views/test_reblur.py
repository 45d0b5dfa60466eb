"""The re-blur residual: a traced stack with its truth passes every gate, and each fault fails the gate that names it."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from capture.report.examination import Examination, _lit_by, examine, predict
from capture.report.exclusion import noise_deviation
from capture.report.findings import StackFindings
from capture.report.gates import BLUR, DEPTH, EXPOSURE, FOCUS, MOTION, PLACE, RESIDUAL, SPACING
from capture.report.slice_fit import NAMES, DepthEvidence, Prediction, fit_slice, normal_equations
from capture.report.stack_gates import stack_gates
from capture.report.stack_view import Reblur, StackView
from mrbokeh.images.image_metrics import psnr
from mrbokeh.images.layer import opaque
from mrbokeh.layering.layering import Layering
from mrbokeh.optics.aperture import Aperture
from mrbokeh.renderers.polygon.polygon_differences import PolygonDifferences
from mrbokeh.renderers.scatter_reference import ScatterReference
from mrbokeh.stacks.focal_stack import FocalStack
from tests.support.traced_focal_stack import FOCUS_M, LENS, SLICES, TracedStack, traced, write_stack

# A third of the usual slices: less than half the time, and blur here is small.
REBLUR = Reblur(PolygonDifferences(layering=Layering(slices=5), threads=1))


@pytest.fixture(scope="module")
def truth() -> TracedStack:
    return traced()


@pytest.fixture(scope="module")
def right(truth: TracedStack, tmp_path_factory: pytest.TempPathFactory) -> FocalStack:
    return write_stack(tmp_path_factory.mktemp("right") / "view_0", truth)


def examined(stack: FocalStack) -> Examination:
    return examine(StackView(stack), REBLUR)


def findings_of(stack: FocalStack) -> StackFindings:
    return examined(stack).findings


def failures(stack: FocalStack) -> set[str]:
    return {each.name for each in stack_gates(findings_of(stack)) if each.failed}


@pytest.mark.slow
def test_the_prediction_is_what_the_renderer_makes_of_depth_and_lens(right: FocalStack) -> None:
    """Reblur takes a map of diameters and invents a lens for it; the plain way is to render depth with the lens of the slice."""
    view = StackView(right)
    for index in (0, 3, 5):
        lens = right.lens_of(index)
        enlarged = replace(lens, f_number=lens.f_number / right.slices[index].scale)
        plainly = REBLUR.renderer.render([opaque(view.all_in_focus, right.depth_m())], enlarged).rgb
        np.testing.assert_allclose(REBLUR(view.all_in_focus, view.coc_px(index), view.aperture), plainly, atol=2e-5)


def test_in_focus_everywhere_is_the_all_in_focus_picture_and_the_exact_renderer_agrees(right: FocalStack) -> None:
    view = StackView(right)
    np.testing.assert_array_equal(REBLUR(view.all_in_focus, np.zeros_like(view.dioptres), Aperture.disc()), view.all_in_focus)
    # The polygon renderer's kernels are within 55 dB of exact ones, far below the residual.
    coc_px = view.coc_px(5)
    fast, exact = (each(view.all_in_focus, coc_px, view.aperture) for each in (REBLUR, Reblur(ScatterReference(threads=1))))
    assert psnr(fast, exact) > 52.0


def test_a_right_stack_passes_every_gate(right: FocalStack) -> None:
    found = findings_of(right)
    gates = stack_gates(found)
    assert not [each for each in gates if each.failed]
    # 32 rays per pixel leave noise of 1 to 1.5 % (37 to 40 dB) in the slices; without blur they are 22 to 30 dB away.
    assert all(each.psnr_db is not None and each.psnr_db > 37.0 for each in found.slices)
    assert all(each.unblurred_db is not None and each.unblurred_db < 31.0 for each in found.slices)
    assert found.moving_share == 0.0


# The faults, as (right stack, its truth, folder) -> stack.
Fault = Callable[[FocalStack, TracedStack, Path], FocalStack]


def f_number_wrong(stack: FocalStack, _: TracedStack, __: Path) -> FocalStack:
    """Blur of a lens one tenth faster: what is photographed is 1 - 1/1.1 = 9 % smaller."""
    return replace(stack, lens=replace(LENS, f_number=LENS.f_number / 1.1))


def all_focus_wrong(stack: FocalStack, _: TracedStack, __: Path) -> FocalStack:
    """0.1 dioptre times 8.8 px per dioptre is 0.9 px."""
    moved = (replace(each, focus_distance_m=1.0 / (1.0 / (each.focus_distance_m or 1.0) + 0.1)) for each in stack.slices)
    return replace(stack, slices=tuple(moved))


def one_focus_wrong(stack: FocalStack, _: TracedStack, __: Path) -> FocalStack:
    slices = list(stack.slices)
    slices[2] = replace(slices[2], focus_distance_m=1.0 / (1.0 / FOCUS_M[2] + 0.1))
    return replace(stack, slices=tuple(slices))


def depth_scaled(_: FocalStack, truth: TracedStack, folder: Path) -> FocalStack:
    return write_stack(folder, replace(truth, depth_m=1.1 * truth.depth_m))


def swapped(stack: FocalStack, _: TracedStack, __: Path) -> FocalStack:
    """The pictures of slices 2 and 3 are exchanged; their focus distances stay."""
    order = (0, 1, 3, 2, 4, 5)
    return replace(stack, slices=tuple(replace(each, path=stack.slices[i].path) for each, i in zip(stack.slices, order, strict=True)))


def missing(stack: FocalStack, _: TracedStack, __: Path) -> FocalStack:
    return replace(stack, slices=stack.slices[:3] + stack.slices[4:])


def brighter(_: FocalStack, truth: TracedStack, folder: Path) -> FocalStack:
    gains = np.array([1, 1, 1.02, 1, 1, 1], np.float32)[:, None, None, None]
    return write_stack(folder, replace(truth, slices=truth.slices * gains))


def moved(_: FocalStack, truth: TracedStack, folder: Path) -> FocalStack:
    """The card at 1 m goes 3 cm to the right after slice 2."""
    later = traced(0, 0.13, from_slice=3)
    return write_stack(folder, replace(truth, slices=np.concatenate([truth.slices[:3], later.slices])))


def depth_wrong(_: FocalStack, truth: TracedStack, folder: Path) -> FocalStack:
    """0.25 dioptre, which is 2.2 px, over 16 % of the picture."""
    depth_m = truth.depth_m.copy()
    depth_m[33:83, 104:158] = 1.0 / (1.0 / depth_m[33:83, 104:158] + 0.25)
    return write_stack(folder, replace(truth, depth_m=depth_m))


def shifted(_: FocalStack, truth: TracedStack, folder: Path) -> FocalStack:
    slices = truth.slices.copy()
    slices[4] = np.roll(slices[4], 1, axis=1)
    return write_stack(folder, replace(truth, slices=slices))


SLOW = ((all_focus_wrong, FOCUS), (one_focus_wrong, FOCUS), (depth_scaled, FOCUS), (swapped, FOCUS), (missing, SPACING))


@pytest.mark.parametrize(
    ("fault", "gate"),
    [
        *((f_number_wrong, BLUR), (brighter, EXPOSURE), (moved, MOTION), (depth_wrong, DEPTH), (shifted, PLACE)),
        *(pytest.param(*each, marks=pytest.mark.slow) for each in SLOW),
    ],
)
def test_every_fault_fails_the_gate_that_names_it(
    fault: Fault, gate: object, right: FocalStack, truth: TracedStack, tmp_path: Path
) -> None:
    assert getattr(gate, "name", None) in failures(fault(right, truth, tmp_path / "view_0"))


@pytest.mark.slow
@pytest.mark.parametrize("fault", [one_focus_wrong, swapped])
def test_slices_beside_the_wrong_one_are_not_blamed(fault: Fault, right: FocalStack, truth: TracedStack, tmp_path: Path) -> None:
    fits = [each.fit for each in findings_of(fault(right, truth, tmp_path)).slices if each.fit is not None]
    assert len(fits) == SLICES
    assert not any(fits[i].focus_px.exceeds(0.6) for i in (0, 1, 4, 5))
    assert fits[2].focus_px.exceeds(0.6)


def test_what_moved_is_found_where_it_moved(truth: TracedStack, tmp_path: Path) -> None:
    """The mask against the pixels that differ by more than a tenth between the two scenes, sharp: most of them, and little else.

    Where blur washes out the checks of the card, before and after look alike: 17 % here.
    """
    later = traced(0, 0.13, from_slice=3)
    transient = np.concatenate([truth.slices[:3], later.slices[:1], truth.slices[4:]])
    found = examined(write_stack(tmp_path / "view_0", replace(truth, slices=transient))).moving
    differs = (np.abs(truth.all_in_focus - later.all_in_focus).max(axis=2) > 0.1) & inside(truth.depth_m.shape)
    assert found[differs].mean() > 0.75
    # Blur of up to 10 px carries the change beyond its outline; farther off nothing is marked.
    assert found.mean() < 3.0 * differs.mean()


def test_discs_of_clipped_lights_are_not_judged_for_movement() -> None:
    """A disc of 20 px reaches 10 px; where nothing is clipped all is judged."""
    clipped = np.zeros((60, 80), bool)
    assert not _lit_by(clipped, np.full((60, 80), 20.0, np.float32)).any()
    clipped[30, 40] = True
    lit = _lit_by(clipped, np.full((60, 80), -20.0, np.float32))
    y, x = np.indices(lit.shape)
    away_px = np.hypot(y - 30, x - 40)
    assert lit[away_px <= 10.0].all() and not lit[away_px > 12.0].any()


@pytest.mark.slow
def test_noise_is_not_movement(truth: TracedStack, tmp_path: Path) -> None:
    found = findings_of(write_stack(tmp_path / "view_0", truth, noise=0.02))
    assert found.moving_share == 0.0
    assert not [each for each in stack_gates(found) if each.failed]


def smooth_texture(shape: tuple[int, int]) -> np.ndarray:
    """Without detail finer than the kernels, under which a change of half a pixel would no longer be a small one."""
    noise = np.random.default_rng(3).random((*shape, 3)).astype(np.float32)
    return np.clip(0.5 + 3.0 * (cv2.GaussianBlur(noise, (0, 0), 1.5) - 0.5), 0.0, 1.0).astype(np.float32)


def textured_prediction(shape: tuple[int, int] = (96, 128)) -> Prediction:
    """A texture under a slope of diameters, by the exact renderer: no tracing, no depth edges."""
    return predict_map(smooth_texture(shape), np.broadcast_to(np.linspace(3.0, 8.0, shape[1], dtype=np.float32), shape).copy())


def predict_map(texture: np.ndarray, coc_px: np.ndarray) -> Prediction:
    reblur = Reblur(ScatterReference(threads=1))
    rgb, less, more = (reblur(texture, (coc_px + step).astype(np.float32), Aperture.disc()) for step in (0.0, -1.0, 1.0))
    return Prediction(rgb, less, more, coc_px, 1.0)


def inside(shape: tuple[int, ...], margin: int = 8) -> np.ndarray:
    mask = np.zeros(shape[:2], bool)
    mask[margin:-margin, margin:-margin] = True
    return mask


def test_sums_of_cells_are_those_of_their_pixels() -> None:
    """Plainly: every pair of columns multiplied over the whole picture, then added up in each of 6 by 8 cells."""
    rng = np.random.default_rng(2)
    columns, weight = rng.standard_normal((4, 31, 45, 3)).astype(np.float32), rng.random((31, 45)).astype(np.float32)
    matrices, sides = normal_equations(columns, weight)
    rows, across = (np.repeat(np.arange(cells), np.diff(np.linspace(0, size, cells + 1).astype(int))) for size, cells in ((31, 6), (45, 8)))
    cell = 8 * rows[:, None] + across[None, :]
    for i in range(3):
        for j in range(4):
            product = (columns[i].astype(float) * columns[j] * weight[..., None]).sum(axis=2)
            expected = np.bincount(cell.ravel(), product.ravel(), minlength=48)
            np.testing.assert_allclose(sides[:, i] if j == 3 else matrices[:, i, j], expected, atol=1e-5)


def test_the_fit_reads_back_the_changes_that_were_made() -> None:
    """Each change by itself, in the model's own words: the fit is linear, so that its numbers must come back."""
    prediction = textured_prediction()
    rgb, per_px, coc = prediction.rgb, prediction.per_px, prediction.coc_px[..., None]
    down, right = np.gradient(rgb, axis=(0, 1))
    made = {"exposure": 0.03 * rgb, "focus_px": 0.2 * per_px, "blur_gain": 0.04 * per_px * coc, "shift_x_px": -0.1 * right}
    made |= {"shift_y_px": 0.2 * down}
    expected = {"exposure": 0.03, "focus_px": 0.2, "blur_gain": 0.04, "shift_x_px": 0.1, "shift_y_px": -0.2}
    for name, change in made.items():
        fit, remaining = fit_slice((rgb + change).astype(np.float32), prediction, inside(rgb.shape))
        assert fit.changes[name].value == pytest.approx(expected[name], rel=0.01), name
        assert np.abs(remaining).max() < 1e-4
        others = [each.value for other, each in fit.changes.items() if other != name]
        assert np.abs(others).max() < 0.01, name


def test_the_fit_finds_real_changes_of_focus_and_blur() -> None:
    """Not derivatives but other renderings: half a pixel more everywhere, or 6 % more."""
    texture = smooth_texture((96, 128))
    coc_px = np.broadcast_to(np.linspace(-8.0, 8.0, 128, dtype=np.float32), (96, 128)).copy()
    prediction = predict_map(texture, coc_px)
    more = predict_map(texture, coc_px + np.float32(0.5)).rgb
    larger = predict_map(texture, coc_px * np.float32(1.06)).rgb
    counted = inside(texture.shape)
    assert fit_slice(more, prediction, counted)[0].focus_px.value == pytest.approx(0.5, abs=0.1)
    assert fit_slice(larger, prediction, counted)[0].blur_gain.value == pytest.approx(0.06, abs=0.015)


def test_standard_errors_are_those_of_repeated_noise() -> None:
    """Of 30 slices with noise of their own, changes scatter as their standard errors say: within a factor of 2, for 48 cells are few.

    Where nothing is counted, nothing is known.
    """
    prediction = textured_prediction((64, 96))
    nothing, _ = fit_slice(prediction.rgb, prediction, np.zeros((64, 96), bool))
    assert all(each.error == float("inf") and not each.exceeds(0.0) for each in nothing.changes.values())
    rng = np.random.default_rng(0)
    fits = []
    for _ in range(30):
        noisy = prediction.rgb + 0.01 * rng.standard_normal(prediction.rgb.shape)
        fits.append(fit_slice(noisy.astype(np.float32), prediction, inside(noisy.shape))[0])
    for name in NAMES:
        scatter = np.std([fit.changes[name].value for fit in fits])
        claimed = np.mean([fit.changes[name].error for fit in fits])
        assert 0.5 < claimed / scatter < 2.0, name


def test_depth_evidence_reads_back_an_error_of_depth() -> None:
    """Slices in front of and behind the focus pull in one direction: 0.4 px here, and the sign is that of too large a diameter."""
    evidence = DepthEvidence()
    for sign in (1.0, -1.0):
        prediction = textured_prediction()
        wrong = Prediction(prediction.rgb, prediction.less, prediction.more, prediction.coc_px * np.float32(sign), 1.0)
        evidence.add((-0.4 * wrong.per_px).astype(np.float32), wrong, inside(wrong.rgb.shape))
    check = evidence.check()
    told = check.told & inside(check.told.shape, 16)
    assert told.mean() > 0.4
    np.testing.assert_allclose(check.off_px[told], 0.4, atol=0.02)


def test_the_noise_of_a_residual_is_measured_by_radiance() -> None:
    """Photon noise of 0.02 at radiance 1: 0.01 at a quarter."""
    level = np.tile(np.linspace(0.05, 1.0, 256, dtype=np.float32), (256, 1))
    residual = (0.02 * np.sqrt(level) * np.random.default_rng(0).standard_normal(level.shape)).astype(np.float32)
    deviation = noise_deviation(residual, level)
    assert deviation[:, 240].mean() == pytest.approx(0.02, rel=0.1)
    assert deviation[:, 54].mean() == pytest.approx(0.01, rel=0.15)


def test_a_wide_stack_is_judged_smaller_with_smaller_blur(right: FocalStack) -> None:
    """At half the width everything is half as large, also the circles of confusion."""
    whole, half = StackView(right), StackView(right, 80)
    assert half.all_in_focus.shape == (54, 80, 3)
    assert np.abs(half.coc_px(0)).max() == pytest.approx(0.5 * np.abs(whole.coc_px(0)).max(), rel=0.02)
    prediction = predict(half, 5, REBLUR)
    assert psnr(prediction.rgb, half.slice_rgb(5)) > 38.0


@pytest.mark.slow
def test_a_fault_leaves_its_mark_in_the_residual_too(right: FocalStack, truth: TracedStack, tmp_path: Path) -> None:
    found = findings_of(shifted(right, truth, tmp_path / "view_0"))
    assert RESIDUAL.name in {each.name for each in stack_gates(found) if each.failed}
    assert min(range(SLICES), key=lambda i: found.slices[i].psnr_db or 0.0) == 4
