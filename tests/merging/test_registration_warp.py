"""Resampling to the reference, and where it has data."""

import cv2
import numpy as np
import pytest

from capture.merging.registration.plane_transforms import (
    Transform,
    about_centre,
    as_similarity,
    at_scale,
    chained,
    inverse,
    moved,
    scale_of,
    to_opencv_centres,
    warp,
    warped_validity,
)

TURNED = np.array([[1.03, -0.05, 6.4], [0.05, 1.03, -9.7]])
PERSPECTIVE = np.array([[1.03, -0.05, 6.4], [0.05, 1.03, -9.7], [2e-4, -1.5e-4, 1.0]])


def warped_at_once(rgb: np.ndarray, transform: Transform) -> np.ndarray:
    """The plain twin of `warp`, which goes in strips."""
    size, matrix, box = (rgb.shape[1], rgb.shape[0]), to_opencv_centres(transform), np.ones((3, 3), np.uint8)

    def sampled(image: np.ndarray, method: int) -> np.ndarray:
        by = cv2.warpPerspective if len(matrix) == 3 else cv2.warpAffine
        return by(image, matrix, size, flags=method, borderMode=cv2.BORDER_REPLICATE)

    lowest, highest = sampled(cv2.erode(rgb, box), cv2.INTER_NEAREST), sampled(cv2.dilate(rgb, box), cv2.INTER_NEAREST)
    return np.clip(sampled(rgb, cv2.INTER_CUBIC), lowest, highest)


@pytest.mark.parametrize(
    "transform",
    [TURNED, inverse(TURNED), PERSPECTIVE, inverse(PERSPECTIVE), about_centre(0.5, 170, 300), np.array([[1.0, 0, 0], [0, 1.0, 700.0]])],
)
def test_strips_are_no_different_from_the_whole(transform: Transform) -> None:
    """300 rows make three strips. Smooth, since OpenCV rounds positions to 1/32 px, in which strips may differ."""
    noise = np.random.default_rng(0).uniform(0, 1, (300, 170, 3)).astype(np.float32)
    rgb = cv2.GaussianBlur(noise, (0, 0), 4)
    np.testing.assert_allclose(warp(rgb, transform), warped_at_once(rgb, transform), atol=3e-3)


def test_warping_beside_a_light_makes_no_dark_holes() -> None:
    rgb = np.full((40, 40, 3), 0.1, np.float32)
    rgb[20, 20] = 500.0
    warped = warp(rgb, np.array([[1.0, 0, 0.4], [0, 1.0, 0.3]]))
    assert warped.min() >= 0.1 - 1e-6 and warped.max() <= 500.0


def test_warping_moves_by_what_it_says() -> None:
    rgb = np.zeros((20, 30, 3), np.float32)
    rgb[8, 10] = 1.0
    shifted = warp(rgb, np.array([[1.0, 0, 3.0], [0, 1.0, -2.0]]))
    assert np.unravel_index(shifted[..., 0].argmax(), (20, 30)) == (6, 13)
    # Scaling by 2 about (0, 0) takes the centre of pixel (10, 8), at (10.5, 8.5), to (21, 17): the corner of four pixels.
    doubled = warp(rgb, np.array([[2.0, 0, 0], [0, 2.0, 0]]))[..., 0]
    np.testing.assert_allclose(doubled[16, 20], doubled[17, 21], rtol=1e-5)


def test_identity_returns_the_very_picture() -> None:
    rgb = np.ones((8, 9, 3), np.float32)
    assert warp(rgb, np.eye(2, 3)) is rgb


@pytest.mark.parametrize(("transform", "valid_columns", "valid_rows"), [
    (np.eye(2, 3), (0, 30), (0, 20)),
    (np.array([[1.0, 0, 3.0], [0, 1.0, -2.0]]), (3, 30), (0, 18)),
    # Half a pixel off, the last column would lie half outside the last centre.
    (np.array([[1.0, 0, 0.5], [0, 1.0, 0.0]]), (1, 30), (0, 20)),
    # At half size about the centre pixel centres reach from 7.75 to 22.25 and from 5.25 to 14.75.
    (about_centre(0.5, 30, 20), (8, 22), (5, 15)),
    (about_centre(2.0, 30, 20), (0, 30), (0, 20)),
])  # fmt: skip
def test_validity_of_known_transforms(transform: Transform, valid_columns: tuple[int, int], valid_rows: tuple[int, int]) -> None:
    expected = np.zeros((20, 30), bool)
    expected[slice(*valid_rows), slice(*valid_columns)] = True
    np.testing.assert_array_equal(warped_validity((20, 30), transform), expected)


@pytest.mark.parametrize("transform", [TURNED, PERSPECTIVE, inverse(PERSPECTIVE)])
def test_validity_is_where_a_border_of_another_colour_does_not_show(transform: Transform) -> None:
    """The plain twin: warp a picture of ones with zeros around it; 1 is where nothing of them came in."""
    ones = np.ones((200, 150), np.float32)
    by = cv2.warpPerspective if len(transform) == 3 else cv2.warpAffine
    warped = by(ones, to_opencv_centres(transform), (150, 200), flags=cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT)
    # OpenCV rounds positions to 1/32 px.
    assert (warped_validity((200, 150), transform) != (warped > 1.0 - 1e-6)).mean() < 0.004


@pytest.mark.parametrize("transform", [TURNED, PERSPECTIVE])
def test_transforms_are_a_group(transform: Transform) -> None:
    points = np.array([[0.0, 0.0], [31.5, 7.25]])
    there = moved(transform, points)
    np.testing.assert_allclose(moved(chained(inverse(transform), transform), points), points, atol=1e-12)
    np.testing.assert_allclose(moved(chained(transform, TURNED), points), moved(transform, moved(TURNED, points)), atol=1e-12)
    np.testing.assert_allclose(moved(at_scale(transform, 0.25), 0.25 * points), 0.25 * there, atol=1e-12)
    np.testing.assert_allclose(moved(to_opencv_centres(transform), points - 0.5), there - 0.5, atol=1e-12)
    assert scale_of(chained(TURNED, TURNED)) == pytest.approx(1.03**2 + 0.05**2)


def test_a_homography_enlarges_by_the_root_of_the_area_that_it_makes() -> None:
    """A square of a hundredth of a pixel and what becomes of it."""
    square = np.array([40.0, 70.0]) + 0.005 * np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]])
    x, y = moved(PERSPECTIVE, square).T
    area = 0.5 * abs(np.dot(x, np.roll(y, 1)) - np.dot(y, np.roll(x, 1)))
    assert scale_of(PERSPECTIVE, (40.0, 70.0)) == pytest.approx(np.sqrt(area) / 0.01, rel=1e-6)


def test_the_similarity_of_an_affine_transform_keeps_the_centre() -> None:
    """Shear about a corner moves the centre; what is left of it must not."""
    sheared = np.array([[1.0, 0.01, 0.0], [0.0, 1.02, 0.0]])
    found = as_similarity(sheared, 400, 300)
    np.testing.assert_allclose(moved(found, np.array([[200.0, 150.0]])), [[201.5, 153.0]])
    np.testing.assert_allclose(found[:, :2], [[1.01, 0.005], [-0.005, 1.01]])
