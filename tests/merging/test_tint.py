"""Gain and tint of slices: found through blur and breathing, left alone where there is none."""

from pathlib import Path

import cv2
import numpy as np
import pytest

from capture.merging.merge import merge_stack
from capture.merging.registration.alignment import register_stack
from capture.merging.registration.plane_transforms import about_centre, inverse
from capture.merging.registration.registered_slices import SmallSlice, tint_gains, with_gain
from capture.merging.registration.registration_file import write_registration
from mrbokeh.images.camera_rgb import write_camera_rgb
from mrbokeh.stacks.focal_stack import FocalStack, Slice, read_focal_stack, write_focal_stack
from tests.support.refusals import refused

SIZE = (240, 360)
SCALES = (1.03, 1.02, 1.01, 1.0)
BLUR_PX = (6.0, 3.0, 0.5, 4.0)
TINTS = np.array([[1.06, 1.0, 0.9], [1.04, 1.0, 0.94], [1.02, 1.0, 0.97], [1.0, 1.0, 1.0]])


def slices_of(gains: np.ndarray) -> list[np.ndarray]:
    """One texture under a slope of light, blurred and breathed as in a focus stack, each slice with its gains."""
    rng = np.random.default_rng(3)
    coarse = cv2.resize(rng.uniform(0.1, 0.6, (24, 36, 3)).astype(np.float32), SIZE[::-1], interpolation=cv2.INTER_CUBIC)
    scene = np.clip(coarse + rng.normal(0.0, 0.05, (*SIZE, 3)).astype(np.float32), 0.02, 0.9)
    slices = []
    for scale, sigma_px, gain in zip(SCALES, BLUR_PX, gains, strict=True):
        blurred = cv2.GaussianBlur(scene, (0, 0), sigma_px)
        breathed = cv2.warpAffine(blurred, about_centre(scale, *SIZE[::-1]), SIZE[::-1], borderMode=cv2.BORDER_REFLECT)
        slices.append((breathed * gain).astype(np.float32))
    return slices


def gains_of(slices: list[np.ndarray], saturated: np.ndarray) -> np.ndarray:
    transforms = [inverse(about_centre(scale, *SIZE[::-1])) for scale in SCALES]
    return tint_gains([SmallSlice.of(each, saturated) for each in slices], transforms, len(slices) - 1)


def test_a_drift_of_the_light_is_undone() -> None:
    found = gains_of(slices_of(TINTS), np.zeros(SIZE, np.float32))
    np.testing.assert_allclose(found * TINTS, 1.0, atol=0.01)


def test_slices_of_even_light_stay_as_they_are() -> None:
    np.testing.assert_array_equal(gains_of(slices_of(np.ones((4, 3))), np.zeros(SIZE, np.float32)), 1.0)


def test_what_is_full_does_not_count() -> None:
    """A window that is full in all slices has no tint; without its mask it would halve what is found."""
    slices, full = slices_of(TINTS), np.zeros(SIZE, np.float32)
    full[:, :180] = 1.0
    for each in slices:
        each[:, :180] = 1.0
    np.testing.assert_allclose(gains_of(slices, full) * TINTS, 1.0, atol=0.015)


@pytest.mark.parametrize("strength", [0.5, 2.0])
def test_slices_of_another_scene_tell_nothing(strength: float) -> None:
    slices = slices_of(np.ones((4, 3)))
    slices[1] = strength * np.ascontiguousarray(slices[1][::-1, ::-1])
    np.testing.assert_array_equal(gains_of(slices, np.zeros(SIZE, np.float32)), 1.0)


def test_one_colour_that_does_not_tell_leaves_the_slice_without_a_tint() -> None:
    slices, rng = slices_of(np.full((4, 3), 1.0)), np.random.default_rng(1)
    slices[3] *= 0.92
    patches = cv2.resize(rng.uniform(0.8, 1.2, (12, 18)).astype(np.float32), SIZE[::-1], interpolation=cv2.INTER_NEAREST)
    slices[3][..., 0] *= patches
    np.testing.assert_array_equal(gains_of(slices, np.zeros(SIZE, np.float32)), 1.0)


def test_light_too_dark_to_tell_is_left_alone() -> None:
    dark = [each * np.float32(0.01) for each in slices_of(TINTS)]
    np.testing.assert_array_equal(gains_of(dark, np.zeros(SIZE, np.float32)), 1.0)


def test_what_is_full_stays_full_and_white() -> None:
    codes = np.linspace(0.0, 1.0, 101, dtype=np.float32)
    rgb = np.repeat(codes[None, :, None], 3, axis=2)
    found = with_gain(rgb, np.array([0.9, 1.0, 1.08]))[0]
    np.testing.assert_array_equal(found[98:], rgb[0, 98:])
    np.testing.assert_allclose(found[:85], rgb[0, :85] * [0.9, 1.0, 1.08], rtol=1e-6)
    assert (np.diff(found, axis=0) > -1e-6).all(), "brighter light stays brighter"


def made_stack(folder: Path, slices: list[np.ndarray]) -> FocalStack:
    for index, rgb in enumerate(slices):
        write_camera_rgb(folder / f"slices/{index:02d}.exr", rgb, None)
    stack = FocalStack(folder, tuple(Slice(f"slices/{index:02d}.exr", None) for index in range(len(slices))))
    write_focal_stack(stack)
    return stack


def test_merged_slices_have_the_light_of_the_reference_also_after_an_interruption(tmp_path: Path) -> None:
    """A file that an earlier version left without a gain is made again."""
    stack = made_stack(tmp_path, slices_of(TINTS))

    def spread(merged: FocalStack) -> float:
        means = np.array([each[60:180, 90:270].mean(axis=(0, 1)) for each in merged.iter_rgb()])
        return float((means.max(axis=0) / means.min(axis=0)).max())

    assert spread(merge_stack(stack)) < 1.02
    write_camera_rgb(tmp_path / "registered/00.exr", stack.slice_camera_rgb(0), None)
    assert spread(merge_stack(stack)) < 1.02


def test_flat_slices_merge_without_a_number_that_is_none(tmp_path: Path) -> None:
    """Only where somebody says how they lie: by themselves they are refused, as a phone's two sheets of white, and nothing is written."""
    stack = made_stack(tmp_path, [np.full((*SIZE, 3), 0.3, np.float32)] * 3)
    refused(r"no two neighbours of 3 show the same \(correlation at most 0.00\): leave them out", merge_stack, stack)
    assert not read_focal_stack(tmp_path).merged and not (tmp_path / "all_in_focus.exr").exists()
    given = tmp_path / "given.json"
    write_registration(given, register_stack(lambda _: np.full((*SIZE, 3), 0.3, np.float32), 3, [50.0] * 3))
    merge_stack(stack, registration=given)
    assert "NaN" not in (tmp_path / "stack.json").read_text()


def test_an_interrupted_overwrite_does_not_say_that_the_stack_is_merged(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    merged = merge_stack(made_stack(tmp_path, slices_of(np.ones((4, 3)))))

    def interrupted(*_: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("capture.merging.merge.focus_volume", interrupted)
    with pytest.raises(KeyboardInterrupt):
        merge_stack(merged, overwrite=True)
    assert not read_focal_stack(tmp_path).merged


def test_light_above_the_largest_half_float_stays_finite(tmp_path: Path) -> None:
    slices = slices_of(np.ones((4, 3)))
    slices[2][100:104, 100:104] = 2e5
    for index, rgb in enumerate(slices):
        write_camera_rgb(tmp_path / f"slices/{index:02d}.exr", rgb, None, half=False)
    stack = FocalStack(tmp_path, tuple(Slice(f"slices/{index:02d}.exr", None) for index in range(len(slices))))
    assert np.isfinite(merge_stack(stack).all_in_focus()).all()
