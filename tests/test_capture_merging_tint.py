"""Gain and tint of slices: found through blur and breathing, left alone where there is none."""

import cv2
import numpy as np
import pytest

from capture.merging.similarity import about_centre, inverse
from capture.merging.tint import SmallSlice, tint_gains

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
