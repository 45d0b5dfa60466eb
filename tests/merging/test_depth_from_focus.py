import itertools

import cv2
import numpy as np

from capture.merging.all_in_focus import sharp_all_in_focus, slice_weight
from capture.merging.depth_from_focus import FocusMap, aggregate_costs, focus_map, peak_parabola
from capture.merging.focus_volume import focus_volume
from capture.merging.lights import find_lights, no_lights
from capture.merging.metres.blur_evidence import disc_kernel
from mrbokeh.images.image_metrics import psnr
from mrbokeh.images.layer import opaque
from mrbokeh.optics.aperture import Aperture
from mrbokeh.renderers.scatter_reference import blur_layer
from tests.support.blended_slices import all_in_focus

SLICES = 5
COC_STEP_PX = 2.5


def texture(size: tuple[int, int] = (96, 128), seed: int = 0) -> np.ndarray:
    noise = np.random.default_rng(seed).uniform(0, 1, (*size, 3)).astype(np.float32)
    return np.clip(0.4 + 2.0 * (cv2.GaussianBlur(noise, (0, 0), 0.8) - 0.5), 0.02, 1.5)


def stack_of(rgb: np.ndarray, true_index: np.ndarray) -> list[np.ndarray]:
    """Slices blurred by discs whose diameter grows with the distance from the focus; borders padded, then cut off."""
    padded, index = np.pad(rgb, ((16, 16), (16, 16), (0, 0)), "reflect"), np.pad(true_index, 16, "edge")
    layer = opaque(padded, np.ones(index.shape, np.float32))
    blurred = [blur_layer(layer, COC_STEP_PX * (index - i), Aperture.disc(24)) for i in range(SLICES)]
    return [(each.rgb / each.alpha[..., None])[16:-16, 16:-16] for each in blurred]


def focus_of(slices: list[np.ndarray]) -> FocusMap:
    return focus_map(focus_volume(slices), find_lights(lambda: slices))


def test_a_flat_textured_plane_is_found_between_slices() -> None:
    for true_index in (1.0, 1.3, 2.5):
        focus = focus_of(stack_of(texture(), np.full((96, 128), true_index, np.float32)))
        # A circle of confusion below 1 px blurs nothing, so 0.5 px of it (0.2 of a step) is as near as texture can tell.
        assert abs(np.median(focus.focus_index) - true_index) * COC_STEP_PX < 0.5
        assert np.median(focus.confidence) > 0.5


def test_a_slanted_plane_is_followed() -> None:
    truth = np.tile(np.linspace(0.3, 3.7, 128, dtype=np.float32), (96, 1))
    focus = focus_of(stack_of(texture(), truth))
    assert np.abs(focus.focus_index - truth)[8:-8, 8:-8].mean() < 0.15


def test_nothing_is_claimed_where_there_is_no_texture() -> None:
    rgb = texture()
    rgb[:, 64:] = 0.4
    focus = focus_of(stack_of(rgb, np.full((96, 128), 2.0, np.float32)))
    assert focus.confidence[:, 80:].max() < 0.2 < focus.confidence[10:-10, 10:50].mean()


def test_the_all_in_focus_picture_of_two_planes() -> None:
    truth = np.ones((96, 128), np.float32)
    truth[:, 64:] = 3.0
    slices, rgb = stack_of(texture(), truth), texture()
    merged = all_in_focus(slices, focus_of(slices).focus_index)
    away_from_edge = np.abs(np.arange(128) - 64) > 8
    assert psnr(merged[:, away_from_edge], rgb[:, away_from_edge]) > 45
    assert max(psnr(each, rgb) for each in slices) < 35, "no slice alone does it"


def test_weights_of_all_slices_sum_to_one() -> None:
    index = np.linspace(0, 4, 101, dtype=np.float32)[None]
    total = sum(slice_weight(index, i) for i in range(5))
    np.testing.assert_allclose(total, 1.0, atol=1e-6)


def test_parabola_through_a_parabola() -> None:
    centres = np.array([[1.7, 2.0, 2.4]])
    volume = -((np.arange(5)[:, None, None] - centres) ** 2).astype(np.float32)
    offset, curvature = peak_parabola(volume, volume.argmax(axis=0))
    np.testing.assert_allclose(volume.argmax(axis=0) + offset, centres, atol=1e-5)
    np.testing.assert_allclose(curvature, 2.0, atol=1e-5)


def test_semi_global_costs_of_a_row_are_those_of_all_paths() -> None:
    """On a single row two of the eight directions have neighbours; their costs are minima over all labelings."""
    rng = np.random.default_rng(0)
    costs = rng.uniform(0, 3, (3, 1, 4)).astype(np.float32)
    small, large = 0.3, 1.0

    def step(a: int, b: int) -> float:
        return 0.0 if a == b else small if abs(a - b) == 1 else large

    def cheapest(row: np.ndarray) -> np.ndarray:
        """(labels, W): the cheapest labeling of the row up to each pixel that ends in each label."""
        result = np.zeros_like(row)
        for x in range(row.shape[1]):
            for last in range(row.shape[0]):
                paths = [(*path, last) for path in itertools.product(range(row.shape[0]), repeat=x)]
                result[last, x] = min(
                    sum(row[label, i] for i, label in enumerate(path)) + sum(step(a, b) for a, b in itertools.pairwise(path))
                    for path in paths
                )
        return result

    def normalised(total: np.ndarray) -> np.ndarray:
        """Each path cost less the cheapest of the pixel before, as Hirschmueller's Eq. 13 subtracts it."""
        before = np.concatenate([np.zeros(1), total.min(axis=0)[:-1]])
        return total - before

    row = costs[:, 0].astype(np.float64)
    there, back = normalised(cheapest(row)), normalised(cheapest(row[:, ::-1]))[:, ::-1]
    expected = there + back + 6 * row  # the other six directions start anew at every pixel
    np.testing.assert_allclose(aggregate_costs(costs, small, large)[:, 0], expected, rtol=1e-5)


def blurred_by_discs(truth: np.ndarray, rng: np.random.Generator, noise: float) -> list[np.ndarray]:
    """Nine slices of a plane that is sharp in slice 2."""
    blurred = [cv2.filter2D(truth, -1, disc_kernel(9.0 * abs(index - 2) + 0.5)) for index in range(9)]
    return [np.maximum(each + rng.normal(0.0, noise, truth.shape), 0.0).astype(np.float32) for each in blurred]


def test_plain_ground_takes_no_halo_from_print() -> None:
    """White print on plain ground beside textured ground, at one depth, blurred by discs in all other slices.

    Truth is the sharp picture: beside the print every other slice shows the light of its discs, and their rims.
    """
    rng = np.random.default_rng(4)
    truth = np.full((240, 480, 3), 0.04, np.float32)
    cv2.circle(truth, (120, 120), 34, (0.7, 0.7, 0.7), 9)
    truth[:, 216:] = rng.uniform(0.1, 0.4, (120, 132, 1)).astype(np.float32).repeat(2, axis=0).repeat(2, axis=1)
    slices = blurred_by_discs(truth, rng, 0.0004)
    volume = focus_volume(slices)
    focus_index = focus_map(volume, no_lights((240, 480))).focus_index
    picture = sharp_all_in_focus(lambda: slices, focus_index, volume)
    ground = cv2.dilate((truth[..., 0] > 0.1).astype(np.uint8), np.ones((15, 15), np.uint8)) == 0
    ground[:, 170:] = False
    off = np.abs(cv2.GaussianBlur(np.sqrt(picture) - np.sqrt(truth), (0, 0), 3.0))[ground]
    # A slice that is blurred by 9 px more would add 0.1 there.
    # Measured 0.0003, 0.005 and 0.11; with choices of small windows alone 0.005, 0.018 and 4.5.
    assert np.percentile(off, 95) < 0.001 and np.percentile(off, 99) < 0.008
    assert np.abs(focus_index[ground] - 2.0).mean() < 0.1


def test_a_plain_board_with_nothing_but_print_takes_no_halo() -> None:
    """Where the whole picture is plain no block is plainer than the others, and most of what looks like detail is that of rims."""
    rng = np.random.default_rng(8)
    printed = np.zeros((240, 480, 3), np.uint8)
    cv2.putText(printed, "SW 12", (20, 170), cv2.FONT_HERSHEY_SIMPLEX, 4.0, (255, 255, 255), 22)
    root = cv2.GaussianBlur(0.17 + 0.6 / 255.0 * printed.astype(np.float32), (0, 0), 3.0)
    slices = blurred_by_discs(root * root, rng, 0.0007)
    volume = focus_volume(slices)
    focus_index = focus_map(volume, no_lights((240, 480))).focus_index
    picture = sharp_all_in_focus(lambda: slices, focus_index, volume)
    off = cv2.GaussianBlur(np.sqrt(picture) - root, (0, 0), 2.0).max(axis=2)
    ground = cv2.dilate((root[..., 0] > 0.19).astype(np.uint8), np.ones((9, 9), np.uint8)) == 0
    # Measured 0; with rims taken for detail 0.1.
    assert (np.abs(focus_index[ground] - 2.0) > 1.0).mean() < 0.01
    # Measured 0.001 of a board of 0.17; 0.035 where blocks are mended whose light moves by it.
    assert np.percentile(off[ground], 99) < 0.01


def test_what_stands_in_for_missing_data_tells_of_no_change() -> None:
    """Slices of a faint, shaded texture of which the last two reach less far to the right, and repeat their last column beyond."""
    rng = np.random.default_rng(1)
    shading = cv2.GaussianBlur(rng.normal(0.0, 1.0, (160, 320)).astype(np.float32), (0, 0), 12.0)
    fine = rng.normal(0.0, 0.01, (80, 160)).astype(np.float32).repeat(2, axis=0).repeat(2, axis=1)
    root = 0.4 + fine + 0.1 * shading / shading.std()
    truth = (root * root)[..., None].repeat(3, axis=2)
    slices, masks = [], []
    for index in range(5):
        blurred = cv2.filter2D(truth, -1, disc_kernel(6.0 * abs(index - 2) + 0.5)) + rng.normal(0.0, 0.001, truth.shape)
        end = 320 - 25 * max(index - 2, 0)
        masks.append(np.tile(np.arange(320) < end, (160, 1)))
        slices.append(np.maximum(np.where(masks[-1][..., None], blurred, blurred[:, end - 1 : end]), 0.0).astype(np.float32))
    focus_index = focus_map(focus_volume(slices, lambda index: masks[index]), no_lights((160, 320))).focus_index
    # Measured 0.025; where the light of what is repeated counts 0.13.
    assert np.abs(focus_index[8:-8, -50:] - 2.0).mean() < 0.06


def test_a_border_that_a_slice_lacks_is_taken_from_another_even_where_it_is_sharpest() -> None:
    """Slice 0 is the sharp one, but its first 40 columns repeat the 41st: streaks, which no slice shows."""
    rng = np.random.default_rng(2)
    root = 0.4 + rng.normal(0.0, 0.02, (80, 160)).astype(np.float32).repeat(2, axis=0).repeat(2, axis=1)
    root[:, :60] = 0.4 + 0.1 * (root[:, :60] - 0.4)
    truth, masks = (root * root)[..., None].repeat(3, axis=2), [np.ones((160, 320), bool) for _ in range(3)]
    slices = [cv2.filter2D(truth, -1, disc_kernel(4.0 * index + 0.5)) + rng.normal(0.0, 0.001, truth.shape) for index in range(3)]
    slices = [np.maximum(each, 0.0).astype(np.float32) for each in slices]
    slices[0][:, :40], masks[0][:, :40] = slices[0][:, 40:41], False
    volume = focus_volume(slices, lambda index: masks[index])
    focus_index = focus_map(volume, no_lights((160, 320))).focus_index
    merged = sharp_all_in_focus(lambda: slices, focus_index, volume)
    assert focus_index[:, :38].min() >= 0.75 and focus_index[:, 60:].max() < 0.5
    np.testing.assert_allclose(merged[:, :30], slices[1][:, :30], atol=0.01)


def test_the_tip_of_a_plain_leaf_is_not_overruled_by_the_ground_behind_it() -> None:
    """A leaf of faint detail, sharp in slice 1, whose tip reaches far over textured ground that is sharp in slice 6."""
    rng = np.random.default_rng(5)
    leaf = np.zeros((240, 320), np.float32)
    cv2.fillConvexPoly(leaf, np.array([[60, 0], [260, 0], [160, 200]], np.int32), 1.0)
    ground = cv2.GaussianBlur(rng.uniform(0.05, 0.3, (240, 320, 1)).astype(np.float32).repeat(3, axis=2), (0, 0), 0.8)
    colour = 0.3 + 0.01 * cv2.GaussianBlur(rng.normal(0.0, 1.0, (240, 320)), (0, 0), 1.0)[..., None].astype(np.float32).repeat(3, axis=2)
    slices = []
    for index in range(8):
        disc = disc_kernel(4.0 * abs(index - 1) + 0.5)
        alpha = cv2.filter2D(leaf, -1, disc)[..., None]
        behind = cv2.filter2D(ground, -1, disc_kernel(8.0 * abs(index - 6) + 0.5))
        blurred = alpha * cv2.filter2D(colour, -1, disc) + (1.0 - alpha) * behind
        slices.append(np.maximum(blurred + rng.normal(0.0, 0.003, blurred.shape), 0.0).astype(np.float32))
    focus_index = focus_map(focus_volume(slices), no_lights((240, 320))).focus_index
    tip = cv2.erode(leaf, np.ones((9, 9))) > 0
    tip[:120] = False
    # Measured 1.0; with Gaussian windows that see past the rim of the leaf 0.25.
    assert (np.abs(focus_index[tip] - 1.0) < 1.0).mean() > 0.95


def test_a_dull_thing_before_fine_texture_keeps_its_outline() -> None:
    """A dark board that is sharp in slice 6, in front of bright grains that are sharp in slice 2 and show through its blurred rim."""
    rng = np.random.default_rng(6)
    board = np.zeros((200, 320), np.float32)
    board[:, :150] = 1.0
    grains = np.clip(0.2 + 0.12 * rng.normal(0.0, 1.0, (200, 320, 1)), 0.02, 1.0).astype(np.float32).repeat(3, axis=2)
    grains = cv2.GaussianBlur(grains, (0, 0), 0.7)
    dull = np.full((200, 320, 3), 0.04, np.float32)
    slices = []
    for index in range(9):
        rim = disc_kernel(8.0 * abs(index - 6) + 0.5)
        alpha = cv2.filter2D(board, -1, rim)[..., None]
        behind = cv2.filter2D(grains, -1, disc_kernel(5.0 * abs(index - 2) + 0.5))
        root = np.sqrt(alpha * dull + (1.0 - alpha) * behind) + rng.normal(0.0, 0.012, grains.shape)
        slices.append(np.square(np.maximum(root, 0.0)).astype(np.float32))
    volume = focus_volume(slices)
    picture = sharp_all_in_focus(lambda: slices, focus_map(volume, no_lights((200, 320))).focus_index, volume)
    step, own = (each[154] - each[146] for each in (np.sqrt(rgb).mean(axis=(0, 2)) for rgb in (picture, slices[6])))
    # Measured 0.93 of the step over 8 px that the board's own slice has; without the say of coarser detail 0.82.
    assert step > 0.9 * own
