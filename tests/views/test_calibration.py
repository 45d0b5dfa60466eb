"""Blur and focus calibrated against known depth, and the calibration of a lens put to use on other stacks."""

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from capture.commands.scale import scale_command
from capture.poses.lens_calibration import (
    CalibratedFocus,
    LensCalibration,
    apply_lens_calibration,
    calibrate_scene,
    read_lens_calibration,
    write_lens_calibration,
)
from capture.scale.focus_calibration import (
    BlurSamples,
    FocusStart,
    StackFocus,
    _Fit,
    calibrate_focus,
    lens_calibrations,
    measure_blur,
    reduced,
    spread_points,
)
from mrbokeh.images.camera_rgb import write_camera_rgb
from mrbokeh.optics.aperture import Aperture
from mrbokeh.optics.camera import Camera
from mrbokeh.optics.lens import Lens
from mrbokeh.stacks.focal_stack import FocalStack, Slice, read_focal_stack, write_focal_stack, write_merged
from mrbokeh.stacks.guessed_metres import stated_distances_m
from tests.support.command_line import printed_by
from tests.support.refusals import refused

FOCUS = np.linspace(1.6, 0.5, 10)
LENS = Lens(35.0, 2.0, 1.0, 23.5)
GROWTH = np.array([LENS.focused_at(1.0 / each).coc_px_per_dioptre(960) for each in FOCUS])


def finely_blurred(picture: np.ndarray, diameter_px: float) -> np.ndarray:
    """A disc drawn with 8 x 8 points in a pixel, without the pixel's own square: what a lens adds to a picture that has it already."""
    large = cv2.resize(picture, None, fx=8, fy=8, interpolation=cv2.INTER_CUBIC)
    y, x = np.mgrid[-60:61, -60:61]
    disc = (np.hypot(x, y) <= 4.0 * diameter_px).astype(np.float32)
    blurred = cv2.filter2D(large, -1, disc / disc.sum(), borderType=cv2.BORDER_REFLECT_101)
    return cv2.resize(blurred, picture.shape[::-1], interpolation=cv2.INTER_AREA)


@pytest.fixture(scope="module")
def texture() -> np.ndarray:
    rng = np.random.default_rng(1)
    return np.clip(cv2.GaussianBlur(rng.normal(0.5, 1.0, (96, 128)).astype(np.float32), (0, 0), 1.2), 0.0, 1.0)


@pytest.mark.parametrize("diameter_px", [3.0, 6.4, 11.0])
def test_blur_is_measured_as_the_diameter_of_the_circle_of_confusion(texture: np.ndarray, diameter_px: float) -> None:
    xy_px = np.array([[x + 0.5, y + 0.5] for x in range(25, 105, 10) for y in range(25, 75, 10)])
    found = measure_blur(texture, iter([finely_blurred(texture, diameter_px)]), xy_px, Aperture.disc())
    assert len(found.diameter_px) > 30
    assert np.median(found.diameter_px) == pytest.approx(diameter_px, abs=0.08)


def test_a_sharp_slice_and_an_unrelated_one_tell_nothing(texture: np.ndarray) -> None:
    xy_px = np.array([[40.5, 40.5], [80.5, 50.5]])
    unrelated = np.ascontiguousarray(texture[::-1, ::-1])
    assert measure_blur(texture, iter([texture, unrelated]), xy_px, Aperture.disc()).diameter_px.size == 0


def blur_samples(points: np.ndarray, growth: np.ndarray, noise_px: float = 0.1, wrong: float = 0.0) -> BlurSamples:
    rng = np.random.default_rng(2)
    diameters = growth[:, None] * np.abs(FOCUS[:, None] - points) + rng.normal(0, noise_px, (len(FOCUS), len(points)))
    diameters = np.where(rng.random(diameters.shape) < wrong, rng.uniform(2.0, 14.0, diameters.shape), diameters)
    slices, indices = np.nonzero((diameters > 1.7) & (diameters < 14.0))
    return BlurSamples(slices, indices, diameters[slices, indices])


POINTS = np.random.default_rng(7).uniform(0.5, 1.6, 300)


@pytest.mark.slow
def test_focus_is_found_from_blur_stated_or_not() -> None:
    """Nikon's 8-bit code: stated up to 0.04 dioptres off, found within 0.003, and the growth of blur, nominally 7 % off, within 1 %."""
    stated = 1.0 / (0.01 * 10 ** (np.round(40 * np.log10(100.0 / FOCUS)) / 40))
    assert np.abs(stated - FOCUS).max() > 0.02
    fit = calibrate_focus(blur_samples(POINTS, 0.93 * GROWTH), POINTS, FocusStart(stated, GROWTH))
    np.testing.assert_allclose(fit.dioptres, FOCUS, atol=0.003)
    np.testing.assert_allclose(fit.px_per_dioptre, 0.93 * GROWTH, rtol=0.01)
    rough = FOCUS + np.random.default_rng(0).normal(0, 0.04, len(FOCUS))
    fit = calibrate_focus(blur_samples(POINTS, GROWTH, wrong=0.15), POINTS, FocusStart(rough, np.ones(len(FOCUS)), 0.5))
    np.testing.assert_allclose(fit.dioptres, FOCUS, atol=0.01)
    np.testing.assert_allclose(fit.px_per_dioptre, GROWTH, rtol=0.03)
    assert (np.abs(fit.dioptres - FOCUS) < 3 * fit.sigma_dioptre).all()


def test_a_focus_that_was_called_infinity_is_looked_for() -> None:
    """Truly 2 m, all points nearer than 1.4 m. From 0 dioptres they all seem too blurred to measure, and a fit alone stays there."""
    points = POINTS[POINTS > 0.7]
    stated, sigma = np.append(FOCUS[:-1], 1e-3), np.append(np.full(9, 0.05), 0.5)
    blur = blur_samples(points, GROWTH, wrong=0.1)
    fit = calibrate_focus(blur, points, FocusStart(stated, GROWTH, sigma, (9,)))
    np.testing.assert_allclose(fit.dioptres, FOCUS, atol=0.01)
    blindly = calibrate_focus(blur, points, FocusStart(stated, GROWTH, sigma))
    assert abs(blindly.dioptres[9] - FOCUS[9]) > 0.1
    others = blur.slices != 9
    lacking = BlurSamples(blur.slices[others], blur.points[others], blur.diameter_px[others])
    fit = calibrate_focus(lacking, points, FocusStart(stated, GROWTH, sigma, (9,)))
    assert fit.dioptres[9] == pytest.approx(1e-3, abs=1e-6) and fit.sigma_dioptre[9] == pytest.approx(0.5, rel=0.05)


def test_what_nothing_is_known_of_stays_as_stated() -> None:
    blur = blur_samples(POINTS, GROWTH)
    others = blur.slices != 4
    lacking = BlurSamples(blur.slices[others], blur.points[others], blur.diameter_px[others])
    fit = calibrate_focus(lacking, POINTS, FocusStart(FOCUS + 0.013, GROWTH))
    assert fit.samples[4] == 0 and fit.dioptres[4] == pytest.approx(FOCUS[4] + 0.013, abs=1e-6)
    assert fit.sigma_dioptre[4] == pytest.approx(0.05, rel=0.05)
    blur = BlurSamples(np.zeros(5, np.int64), np.arange(5), np.full(5, 4.0))
    refused("5 times, but 60 are needed", calibrate_focus, blur, POINTS, FocusStart(FOCUS, GROWTH))


def test_the_jacobian_is_that_of_the_residuals_and_points_are_spread() -> None:
    blur = blur_samples(POINTS[:40], GROWTH)
    fit = _Fit(blur.slices, POINTS[blur.points], blur.diameter_px, FocusStart(FOCUS, GROWTH))
    values = fit.first_values() + np.random.default_rng(0).normal(0, 0.01, 1 + 2 * len(FOCUS))
    within = fit.measurable(values)
    steps = 1e-6 * np.eye(len(values))
    numeric = [(fit.residuals(values + step, within) - fit.residuals(values - step, within)) / 2e-6 for step in steps]
    np.testing.assert_allclose(fit.jacobian(values, within), np.array(numeric).T, atol=2e-3, rtol=1e-4)
    assert len(spread_points(np.array([[3.0, 3.0], [10.0, 12.0], [25.0, 3.0]]))) == 2
    np.testing.assert_allclose(reduced(np.arange(20, dtype=np.float32).reshape(4, 5), 2), [[3.0, 5.0], [13.0, 15.0]])


OFFSET_M = 0.04
ROWS = tuple(
    CalibratedFocus(1.0 / distance, 1.0 / (distance - OFFSET_M) + error, 12.0, 1.01, 0.001)
    for distance, error in ((2.0, 0.0), (1.0, 0.02), (0.7, 0.0))
)
CALIBRATION = LensCalibration("35 mm", 35.0, 2.0, 960, OFFSET_M, ROWS)


def stack_at(folder: Path, distances_m: tuple[float | None, ...], lens: Lens = LENS) -> FocalStack:
    slices = tuple(Slice(f"{index:02d}.exr", each, metadata={"lens_model": "35 mm"}) for index, each in enumerate(distances_m))
    camera = Camera(1920, 1280, (2900.0, 2900.0), (960.0, 640.0))
    return FocalStack(folder, slices, lens, camera, 0)


def test_a_calibration_translates_stated_distances(tmp_path: Path) -> None:
    """1 m is a row; 0.5 m lies beyond the last, where the offset alone counts; 2 m is infinity's last known neighbour."""
    stack = apply_lens_calibration(stack_at(tmp_path, (0.5, 1.0, float("inf"))), CALIBRATION)
    dioptres = [1.0 / each for each in stack.focus_distances_m if each is not None]
    np.testing.assert_allclose(dioptres[:2], [1.0 / 0.46, 1.0 / 0.96 + 0.02], rtol=1e-9)
    assert stack.focus_distances_m[2] == float("inf") and stated_distances_m(stack) == (0.5, 1.0, float("inf"))
    assert stack.lens is not None and stack.lens.focus_distance_m == pytest.approx(0.46)
    assert stack.slices[1].metadata["px_per_dioptre"] == pytest.approx(24.0), "twice as many pixels wide"
    twice = apply_lens_calibration(stack, CALIBRATION)
    assert twice.focus_distances_m == stack.focus_distances_m, "what was stated is translated, never what was calibrated"


def test_calibrations_are_for_their_lens_and_survive_the_disk(tmp_path: Path) -> None:
    for lens in (replace(LENS, focal_length_mm=50.0), replace(LENS, f_number=4.0)):
        refused("calibrate that lens", apply_lens_calibration, stack_at(tmp_path, (1.0,), lens), CALIBRATION)
    refused("was taken with 35 mm 35 mm", apply_lens_calibration, stack_at(tmp_path, (1.0,)), replace(CALIBRATION, lens_model="other"))
    refused(r"01\.exr has none", apply_lens_calibration, stack_at(tmp_path, (1.0, None)), CALIBRATION)
    silent = replace(CALIBRATION, rows=(replace(ROWS[0], stated_dioptre=None),))
    refused("serves no other stack", apply_lens_calibration, stack_at(tmp_path, (1.0,)), silent)
    path = tmp_path / "lens_calibration.json"
    write_lens_calibration(path, CALIBRATION)
    assert read_lens_calibration(path) == CALIBRATION
    path.write_text("[]")
    refused("expected format", read_lens_calibration, path)


def test_stacks_of_a_lens_share_rows_of_the_same_stated_focus(tmp_path: Path) -> None:
    """Two stacks of one lens, the second twice as sure: a row is their mean with weights 1 and 4."""
    stack = stack_at(tmp_path, (0.7, 1.0))
    found = {}
    for name, dioptre, sigma in (("a", 1.00, 0.002), ("b", 1.05, 0.001)):
        fit = calibrate_focus(blur_samples(POINTS, GROWTH), POINTS, FocusStart(FOCUS, GROWTH))
        dioptres, growth, sigmas, samples = (np.array(each) for each in ([1.4, dioptre], [24.0, 24.0], [sigma] * 2, [9, 9]))
        fit = replace(fit, dioptres=dioptres, px_per_dioptre=growth, sigma_dioptre=sigmas, samples=samples)
        found[name] = StackFocus(stack, fit, 1920)
    other_lens = replace(stack, lens=replace(LENS, f_number=4.0))
    found["c"] = replace(found["a"], stack=other_lens)
    first, second = lens_calibrations(found, 0.0)
    assert (first.f_number, second.f_number) == (2.0, 4.0)
    assert [row.stated_dioptre for row in first.rows] == pytest.approx([1.0, 1.0 / 0.7])
    assert first.rows[0].dioptre == pytest.approx(1.04) and first.rows[0].stacks == 2


def test_the_command_calibrates_a_scene_with_its_depth(tmp_path: Path) -> None:
    """Half way between slices at 1 m (calibrated 1 / 0.96 + 0.02 dioptres) and 2 m (1 / 1.96)."""
    scene, path = tmp_path / "scene", tmp_path / "lens_calibration.json"
    write_focal_stack(stack_at(scene / "a", (1.0, 2.0)))
    write_lens_calibration(path, CALIBRATION)
    assert "calibrated by" in printed_by(scale_command, scene, "--lens-calibration", path), "without poses"
    assert read_focal_stack(scene / "a").focus_distances_m[1] == pytest.approx(1.96)
    tmp_path = tmp_path / "merged"
    stack = replace(stack_at(tmp_path, (1.0, 2.0)), merged=True)
    for each in stack.slices:
        write_camera_rgb(tmp_path / each.path, np.zeros((6, 8, 3), np.float32), None)
    half = np.full((6, 8), 0.5, np.float32)
    write_merged(tmp_path, np.zeros((6, 8, 3), np.float32), half, half, np.full((6, 8), 9.0, np.float32))
    write_focal_stack(stack)
    calibrate_scene(tmp_path, CALIBRATION)
    read = read_focal_stack(tmp_path)
    expected = (1.0 / 0.96 + 0.02 + 1.0 / 1.96) / 2.0
    np.testing.assert_allclose(1.0 / read.depth_m(), expected, rtol=1e-5)
    assert stated_distances_m(read) == (1.0, 2.0)
    assert (tmp_path / "depth.png").is_file() and (tmp_path / "merge.png").is_file(), "pictures show the depth as it is now"
