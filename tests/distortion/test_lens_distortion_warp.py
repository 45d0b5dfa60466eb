"""Layers warped into a distorted plate: overscan, lines, light, depth, motion, and what must not change."""

import numpy as np
import pytest

from mrbokeh.distortion import LensDistortion, distorted, overscan_camera
from mrbokeh.distortion.distortion import StMap
from mrbokeh.distortion.warping import resampled, sampled_positions_px, source_positions_px
from mrbokeh.images.layer import Layer, clear
from mrbokeh.layering.motion import MOTION, with_motion
from mrbokeh.layering.pixel_box import Box, lit_box
from mrbokeh.optics.camera import Camera
from tests.support.refusals import refused

PLATE = Camera(320, 214, (270.0, 265.0), (158.3, 109.6))
BARREL = LensDistortion.of("opencv", k1=-0.25, k2=0.08, p1=1e-3, p2=-8e-4)
PINCUSHION = LensDistortion.of("opencv", k1=0.15, k2=0.02)


def random_layer(camera: Camera, seed: int = 0) -> Layer:
    """Half of it clear, the rest of any coverage, with colours of up to 5, and a mask."""
    rng, size = np.random.default_rng(seed), (camera.height_px, camera.width_px)
    alpha = np.where(rng.uniform(size=size) < 0.5, 0.0, rng.uniform(size=size)).astype(np.float32)
    rgb = (rng.uniform(0.0, 5.0, (*size, 3)) * alpha[..., None]).astype(np.float32)
    depth_m = np.where(alpha > 0, rng.uniform(1.0, 9.0, size), np.inf).astype(np.float32)
    return Layer(rgb, alpha, depth_m, {"mask": alpha[..., None].copy()})


@pytest.mark.parametrize("distortion", [BARREL, PINCUSHION, LensDistortion.of("ptlens", b=-0.05), LensDistortion.of("fisheye")])
def test_the_overscan_holds_all_that_the_plate_sees(distortion: LensDistortion) -> None:
    wide = overscan_camera(PLATE, distortion)
    x, y = np.meshgrid(np.linspace(0.0, 320.0, 161), np.linspace(0.0, 214.0, 108))
    seen = source_positions_px(distortion, PLATE, wide, np.stack([x, y], axis=-1))
    assert seen.min() >= 1.0
    assert (seen.reshape(-1, 2).max(axis=0) <= (wide.width_px - 1, wide.height_px - 1)).all()
    corners = np.sort(seen.reshape(-1, 2), axis=0)
    assert (corners[0] < 3.0).all()  # nothing is rendered for nothing
    np.testing.assert_array_equal(wide.camera_from_world, PLATE.camera_from_world)


def test_barrel_keeps_the_plates_pixels_and_pincushion_takes_more_where_sampling_would_drop() -> None:
    wide = overscan_camera(PLATE, BARREL)
    assert wide.focal_px == PLATE.focal_px
    assert wide.width_px > PLATE.width_px and wide.height_px > PLATE.height_px
    shift = np.asarray(wide.principal_px) - PLATE.principal_px
    np.testing.assert_allclose(shift, np.round(shift), atol=1e-9)
    # A plate's pixel then covers at least one of the render's, in every direction: singular values of the derivative.
    wide = overscan_camera(PLATE, PINCUSHION)
    assert wide.focal_px[0] > 1.02 * PLATE.focal_px[0]
    assert wide.focal_px[0] / wide.focal_px[1] == pytest.approx(PLATE.focal_px[0] / PLATE.focal_px[1])
    positions = sampled_positions_px(PINCUSHION, PLATE, wide, Box(0, 214, 0, 320))
    right, down = 0.5 * (positions[1:-1, 2:] - positions[1:-1, :-2]), 0.5 * (positions[2:, 1:-1] - positions[:-2, 1:-1])
    least = np.linalg.svd(np.stack([right, down], axis=-1), compute_uv=False)[..., 1].min()
    assert 0.99 < least < 1.05


def test_without_distortion_nothing_happens_and_whole_pixels_are_cut_off_bit_for_bit() -> None:
    layer = random_layer(PLATE)
    for none in (LensDistortion(), LensDistortion.of("opencv")):
        assert overscan_camera(PLATE, none) is PLATE
        assert distorted(layer, PLATE, PLATE, none) is layer
    wide = Camera(340, 230, PLATE.focal_px, (PLATE.principal_px[0] + 7.0, PLATE.principal_px[1] + 9.0))
    layer = random_layer(wide)
    cut = distorted(layer, wide, PLATE, LensDistortion())
    where = np.s_[9 : 9 + 214, 7 : 7 + 320]
    np.testing.assert_array_equal(cut.rgb, layer.rgb[where])
    np.testing.assert_array_equal(cut.alpha, layer.alpha[where])
    np.testing.assert_array_equal(cut.depth_m, layer.depth_m[where])
    np.testing.assert_array_equal(cut.extra["mask"], layer.extra["mask"][where])


@pytest.mark.parametrize("distortion", [BARREL, PINCUSHION])
def test_positions_are_those_of_the_exact_inverse(distortion: LensDistortion) -> None:
    """Splines over nodes every 16 px: on this small, strongly bent frame to 1e-2 px, on 1080p to 3e-5."""
    for plate, within_px in ((PLATE, 1e-2), (PLATE.resized(1920, 1284), 1e-4)):
        wide, box = overscan_camera(plate, distortion), Box(plate.height_px - 101, plate.height_px, 0, 103)
        x, y = np.arange(-1, 104) + 0.5, np.arange(box.top - 1, box.bottom + 1) + 0.5
        exact = source_positions_px(distortion, plate, wide, np.stack(np.meshgrid(x, y), axis=-1))
        np.testing.assert_allclose(sampled_positions_px(distortion, plate, wide, box), exact, atol=within_px)


def plainly(layer: Layer, positions_px: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The twin: overlaps of every box with every pixel of the source, by hand; (premultiplied colour, alpha)."""
    height, width = positions_px.shape[0] - 2, positions_px.shape[1] - 2
    values = np.concatenate([layer.rgb, layer.alpha[..., None]], axis=2).astype(np.float64)
    out = np.zeros((height, width, 4))
    for y, x in np.ndindex(height, width):
        centre = positions_px[y + 1, x + 1]
        right = (positions_px[y + 1, x + 2] - positions_px[y + 1, x]) / 2
        down = (positions_px[y + 2, x + 1] - positions_px[y, x + 1]) / 2
        size = np.maximum(1.0, np.hypot(right, down))
        share = []
        for axis, count in ((0, layer.width_px), (1, layer.height_px)):
            cells, low, high = np.arange(count), centre[axis] - size[axis] / 2, centre[axis] + size[axis] / 2
            share.append(np.maximum(0.0, np.minimum(cells + 1, high) - np.maximum(cells, low)) / size[axis])
        out[y, x] = np.einsum("j,i,jic->c", share[1], share[0], values)
    return out[..., :3], out[..., 3]


@pytest.mark.parametrize("distortion", [BARREL, LensDistortion.of("opencv", k1=-0.1, k4=0.2)])
def test_the_compiled_loop_does_what_the_plain_one_does(distortion: LensDistortion) -> None:
    plate = PLATE.resized(40, 27)
    wide = overscan_camera(plate, distortion)
    layer, positions = random_layer(wide), sampled_positions_px(distortion, plate, wide, Box(0, 27, 0, 40))
    fast, (rgb, alpha) = resampled(layer, positions, lit_box(layer)), plainly(layer, positions)
    np.testing.assert_allclose(fast.rgb, rgb, atol=2e-6)
    np.testing.assert_allclose(fast.alpha, alpha, atol=1e-6)


@pytest.mark.parametrize("distortion", [BARREL, PINCUSHION])
def test_colour_stays_colour_and_alpha_stays_coverage(distortion: LensDistortion) -> None:
    wide = overscan_camera(PLATE, distortion)
    layer = random_layer(wide)
    even = Layer(layer.alpha[..., None] * np.float32([0.5, 0.25, 2.0]), layer.alpha, layer.depth_m, layer.extra)
    warped = distorted(even, wide, PLATE, distortion)
    assert warped.alpha.min() >= 0.0 and warped.alpha.max() <= 1.0
    np.testing.assert_allclose(warped.rgb, warped.alpha[..., None] * np.float32([0.5, 0.25, 2.0]), rtol=1e-6)
    np.testing.assert_array_equal(warped.extra["mask"][..., 0], warped.alpha)
    full = Layer(np.full_like(layer.rgb, 3.0), np.ones_like(layer.alpha), np.full_like(layer.alpha, 2.0))
    whole = distorted(full, wide, PLATE, distortion)
    np.testing.assert_allclose(whole.rgb, 3.0, rtol=1e-6)
    np.testing.assert_allclose(whole.alpha, 1.0, rtol=1e-6)
    assert whole.alpha.max() <= 1.0
    np.testing.assert_array_equal(whole.depth_m, 2.0)


@pytest.mark.parametrize(("distortion", "each", "together"), [(BARREL, 0.02, 1e-3), (PINCUSHION, 0.005, 1e-3)])
def test_a_small_light_keeps_its_energy(distortion: LensDistortion, each: float, together: float) -> None:
    """A pixel of light 1 covers 1 / |det| of the plate's pixels, with the derivative of the way from plate to render.

    Boxes of one size tile the picture; where their size changes, or where a pixel of the plate is a little less than one of the
    render, they do so but on average.
    """
    wide, rng = overscan_camera(PLATE, distortion), np.random.default_rng(2)
    ratios = []
    for xy_px in rng.uniform((20, 20), (300, 194), (60, 2)):
        x, y = np.floor(source_positions_px(distortion, PLATE, wide, xy_px[None])[0]).astype(int)
        layer = clear(wide.height_px, wide.width_px)
        layer.rgb[y, x], layer.alpha[y, x], layer.depth_m[y, x] = 1000.0, 1.0, 2.0
        around = (np.array([x, y]) + np.array([[0, 0.5], [1, 0.5], [0.5, 0], [0.5, 1]]) - wide.principal_px) / wide.focal_px
        left, right, top, bottom = distortion.distorted_px(around * PLATE.focal_px + PLATE.principal_px, PLATE)
        area = abs(np.linalg.det(np.stack([right - left, bottom - top])))
        ratios.append(float(distorted(layer, wide, PLATE, distortion).rgb[..., 0].sum(dtype=np.float64)) / (1000.0 * area))
    assert np.abs(np.array(ratios) - 1.0).max() < each
    assert abs(float(np.mean(ratios)) - 1.0) < together


def test_a_straight_line_is_bent_as_the_lens_bends_it() -> None:
    """The middle of a line of 3 px, column by column, lies where the model puts the line: to 1/16 px."""
    wide = overscan_camera(PLATE, BARREL)
    y = np.arange(wide.height_px)[:, None] + 0.5
    along = 30.0 + 0.1 * (np.arange(wide.width_px) + 0.5)
    alpha = np.clip(2.0 - np.abs(y - along), 0.0, 1.0).astype(np.float32)
    layer = Layer(np.repeat(alpha[..., None], 3, axis=2), alpha, np.where(alpha > 0, 2.0, np.inf).astype(np.float32))
    warped = distorted(layer, wide, PLATE, BARREL).alpha.astype(np.float64)
    fine = np.linspace(0.0, wide.width_px, 4000)
    points = (np.stack([fine, 30.0 + 0.1 * fine], axis=-1) - wide.principal_px) / wide.focal_px * PLATE.focal_px + PLATE.principal_px
    expected = BARREL.distorted_px(points, PLATE)
    columns = np.arange(4, 316)
    middle = (warped * (np.arange(214)[:, None] + 0.5)).sum(axis=0)[columns] / warped.sum(axis=0)[columns]
    bent = np.interp(columns + 0.5, expected[:, 0], expected[:, 1])
    assert np.ptp(bent - np.linspace(bent[0], bent[-1], len(bent))) > 3.0
    np.testing.assert_allclose(middle, bent, atol=0.06)


def test_depth_is_never_mixed() -> None:
    wide = overscan_camera(PLATE, BARREL)
    near = np.arange(wide.width_px) < 170
    depth_m = np.repeat(np.where(near, 1.0, 5.0)[None], wide.height_px, axis=0).astype(np.float32)
    depth_m[:40] = np.inf
    alpha = np.isfinite(depth_m).astype(np.float32)
    warped = distorted(Layer(np.repeat(alpha[..., None], 3, axis=2), alpha, depth_m), wide, PLATE, BARREL)
    assert set(np.unique(warped.depth_m)) == {1.0, 5.0, np.inf}
    np.testing.assert_array_equal(np.isfinite(warped.depth_m), warped.alpha > 0)


@pytest.mark.parametrize("distortion", [BARREL, PINCUSHION])
def test_motion_is_turned_and_stretched_with_the_picture(distortion: LensDistortion) -> None:
    """Small motion m of the render is distorted_px(x + m) - distorted_px(x) of the plate."""
    wide, motion = overscan_camera(PLATE, distortion), np.array([0.6, -0.3])
    layer = random_layer(wide)
    moving = with_motion(layer, np.broadcast_to(motion.astype(np.float32), (*layer.alpha.shape, 2)).copy())
    warped = distorted(moving, wide, PLATE, distortion)
    start = source_positions_px(distortion, PLATE, wide, PLATE.pixel_centres_px())
    halves = [start + sign * motion / 2 - wide.principal_px for sign in (1, -1)]
    ends = [distortion.distorted_px(each / wide.focal_px * PLATE.focal_px + PLATE.principal_px, PLATE) for each in halves]
    covered = warped.alpha > 0.05
    shown = warped.extra[MOTION][covered] / warped.alpha[covered][:, None]
    np.testing.assert_allclose(shown, (ends[0] - ends[1])[covered], atol=2e-3)


def test_a_small_object_is_warped_as_within_the_whole_picture() -> None:
    """Only its box is worked on; what comes out is the same."""
    wide = overscan_camera(PLATE, BARREL)
    whole = random_layer(wide)
    some = np.zeros(whole.alpha.shape, np.float32)
    some[50:90, 200:260] = 1.0
    small = Layer(whole.rgb * some[..., None], whole.alpha * some, np.where(some > 0, whole.depth_m, np.float32(np.inf)))
    speck = np.zeros_like(some)
    speck[0, 0] = speck[-1, -1] = 1e-6
    large = Layer(small.rgb + speck[..., None], small.alpha, small.depth_m)
    assert lit_box(small).right - lit_box(small).left <= 60
    np.testing.assert_allclose(
        distorted(small, wide, PLATE, BARREL).rgb, distorted(large, wide, PLATE, BARREL).rgb, atol=2e-2
    )  # splines over other nodes: 2e-3 px, times steps of up to 5
    nothing = distorted(clear(wide.height_px, wide.width_px), wide, PLATE, BARREL)
    assert not nothing.alpha.any() and np.isinf(nothing.depth_m).all()


def test_an_st_map_warps_as_its_model() -> None:
    wide = overscan_camera(PLATE, BARREL)
    read_px = BARREL.undistorted_px(PLATE.pixel_centres_px(), PLATE)
    uv = np.stack([read_px[..., 0] / 320, 1.0 - read_px[..., 1] / 214], axis=-1).astype(np.float32)
    by_map = LensDistortion.from_st_map(StMap(uv))
    assert abs(overscan_camera(PLATE, by_map).width_px - wide.width_px) <= 2
    layer = random_layer(wide)
    np.testing.assert_allclose(distorted(layer, wide, PLATE, by_map).rgb, distorted(layer, wide, PLATE, BARREL).rgb, atol=5e-2)


def test_what_the_lens_cannot_see_is_clear_and_a_layer_of_another_camera_refused() -> None:
    """k1 = -1/3 folds at one focal length from the axis, 2/3 of it in the plate: 0.8 focal lengths to the left is nothing."""
    plate, folds = Camera(160, 40, (100.0, 100.0), (80.0, 20.0)), LensDistortion.of("opencv", k1=-1.0 / 3.0)
    wide = overscan_camera(plate, folds)
    full = np.ones((wide.height_px, wide.width_px), np.float32)
    warped = distorted(Layer(np.repeat(full[..., None], 3, axis=2), full, full), wide, plate, folds)
    assert not warped.alpha[:, :10].any() and not warped.alpha[:, -10:].any()
    np.testing.assert_allclose(warped.alpha[:, 20:140], 1.0, rtol=1e-6)
    refused("rendered by the overscanned camera", distorted, clear(10, 10), PLATE, PLATE, BARREL)
