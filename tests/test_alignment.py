from pathlib import Path

import cv2
import numpy as np
import pytest

from capture.merging.alignment import (
    about_centre,
    chained,
    farthest_corner_px,
    inverse,
    register_pair,
    register_stack,
    scale_of,
    structure,
    warp,
)
from mrbokeh.image_io import read_image


def scene(height: int = 300, width: int = 400, seed: int = 0) -> np.ndarray:
    """Detail of many sizes: sums of smoothed noise."""
    rng = np.random.default_rng(seed)
    layers = [cv2.GaussianBlur(rng.uniform(0, 1, (height, width, 3)).astype(np.float32), (0, 0), sigma) * sigma for sigma in (1.5, 4, 10)]
    return np.clip(0.35 + 1.2 * (sum(layers) - np.mean(sum(layers))), 0.01, None).astype(np.float32)


def similarity(scale: float, angle_rad: float, shift_px: tuple[float, float]) -> np.ndarray:
    turn = np.array([[np.cos(angle_rad), -np.sin(angle_rad), 0], [np.sin(angle_rad), np.cos(angle_rad), 0]])
    centred = chained(about_centre(scale, 400, 300), chained(np.array([[1, 0, 200.0], [0, 1, 150.0]]), turn))
    result = chained(centred, np.array([[1, 0, -200.0], [0, 1, -150.0]]))
    result[:, 2] += shift_px
    return result


def corner_error_px(a: np.ndarray, b: np.ndarray) -> float:
    return farthest_corner_px(a, b, 400, 300)


@pytest.mark.parametrize("truth", [
    similarity(1.0, 0.0, (0.0, 0.0)),
    similarity(1.0, 0.0, (7.3, -4.6)),
    similarity(0.93, 0.0, (0.0, 12.0)),
    similarity(1.03, np.deg2rad(0.4), (1.2, -0.8)),
])  # fmt: skip
def test_a_known_movement_is_found_through_different_blur(truth: np.ndarray) -> None:
    """The slice is blurred by another disc than the target, as two slices of a focal stack are."""
    target = scene()
    source = cv2.GaussianBlur(warp(target, inverse(truth)), (0, 0), 2.0)
    found, correlation = register_pair(structure(target), structure(source))
    # 0.3 px is what the issue of a lens lab asks for after registration.
    assert corner_error_px(found, truth) < 0.3
    assert correlation > 0.9


def test_unrelated_pictures_keep_the_prior() -> None:
    found, _ = register_pair(structure(scene(seed=1)), structure(scene(seed=2)), expected_scale=1.02)
    np.testing.assert_allclose(found, about_centre(1.02, 400, 300), atol=1e-9)


def test_the_reference_is_the_slice_with_the_narrowest_view() -> None:
    base = scene()
    magnifications = (1.0, 1.02, 1.05)  # the last one shows things largest, so it sees least
    slices = [warp(base, about_centre(m, 400, 300)) for m in magnifications]
    registration = register_stack(slices.__getitem__, 3)
    assert registration.reference == 2
    np.testing.assert_allclose(registration.scales, [1.05, 1.05 / 1.02, 1.0], rtol=1e-3)


def test_warping_beside_a_light_makes_no_dark_holes() -> None:
    rgb = np.full((40, 40, 3), 0.1, np.float32)
    rgb[20, 20] = 500.0
    warped = warp(rgb, np.array([[1.0, 0, 0.4], [0, 1.0, 0.3]]))
    assert warped.min() >= 0.1 - 1e-6 and warped.max() <= 500.0


def test_warping_moves_by_what_it_says() -> None:
    rgb = np.zeros((20, 30, 3), np.float32)
    rgb[8, 10] = 1.0
    moved = warp(rgb, np.array([[1.0, 0, 3.0], [0, 1.0, -2.0]]))
    assert np.unravel_index(moved[..., 0].argmax(), (20, 30)) == (6, 13)
    # Scaling by 2 about (0, 0) takes the centre of pixel (10, 8), at (10.5, 8.5), to (21, 17): the corner of four pixels.
    doubled = warp(rgb, np.array([[2.0, 0, 0], [0, 2.0, 0]]))[..., 0]
    np.testing.assert_allclose(doubled[16, 20], doubled[17, 21], rtol=1e-5)


def test_identity_returns_the_very_picture() -> None:
    rgb = scene()
    assert warp(rgb, np.eye(2, 3)) is rgb


@pytest.mark.parametrize(("stack", "first", "middle", "expected"), [("button_macro", 0, 5, 0.925), ("pcb_oblique", 0, 3, 1.021)])
def test_breathing_of_real_stacks(shared_data: Path, stack: str, first: int, middle: int, expected: float) -> None:
    """The scales between the middle and the first slice that were measured by others on these photographs."""
    files = sorted((shared_data / "stacks" / stack).glob("[0-9]*.jpg"))[first : middle + 1]
    pictures = [cv2.resize(read_image(file), None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA) for file in files]
    registration = register_stack(pictures.__getitem__, len(pictures))
    assert registration.scales[-1] / registration.scales[0] == pytest.approx(expected, abs=0.004)


def test_scale_of_a_turned_similarity() -> None:
    assert scale_of(similarity(1.07, 0.3, (5, 5))) == pytest.approx(1.07)


def test_a_known_lens_on_a_tripod_keeps_its_prior_and_a_moved_camera_does_not() -> None:
    target = scene()
    still, moved = similarity(1.02, 0.0, (0.1, 0.1)), similarity(1.02, 0.0, (1.2, -0.6))
    for truth, allowed_px in ((still, 0.15), (moved, 0.3)):
        found, _ = register_pair(structure(target), structure(warp(target, inverse(truth))), expected_scale=1.02)
        assert corner_error_px(found, truth) < allowed_px
