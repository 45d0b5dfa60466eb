"""Layered reconstruction: its pictures against many samples of scenes with known truth."""

from collections.abc import Sequence
from dataclasses import replace
from functools import cache, partial

import numpy as np
import pytest

from mrbokeh.images.image_metrics import psnr
from mrbokeh.images.layer import Layer, opaque
from mrbokeh.layering.motion import MOTION
from mrbokeh.optics.aperture import Aperture
from mrbokeh.renderers.layered_reconstruction import LayeredReconstruction, Settings
from mrbokeh.system.errors import InputError
from tests.support.sampled_planes import LENS, Plane, checker, even, fence_scene, sample_planes, truth, waves

SIZE_PX = 64
PAPER = Settings(screen_filter="sheared", recursive_passes=1, enough=np.inf)
FULL = Settings(merge=False, sparse_statistics=False)
FENCE = tuple(fence_scene(SIZE_PX))
MOVING_WAVES = (Plane(waves(20.0), 8.0, motion_px=(6.0, 2.0)),)
HIDDEN_BY_BARS = (Plane(even(0.35), -14.0, covers=lambda x, _: x % 16.0 < 6.0), Plane(checker(9.0, 0.0, 1.0), -9.0))

known_truth = cache(partial(truth, size_px=SIZE_PX, per_pixel=512))
"""Of a tuple of planes; it takes longer than all that is compared with it."""


def picture(planes: Sequence[Plane], per_pixel: int, settings: Settings | None = None, size_px: int = SIZE_PX) -> np.ndarray:
    samples = sample_planes(planes, size_px, per_pixel)
    return LayeredReconstruction(settings or Settings()).reconstruct(samples, LENS).rgb


@pytest.mark.parametrize("screen_filter", ["windows", "sheared", "texture", "texture_one_tap", "direct"])
def test_an_even_light_field_stays_even(screen_filter: str) -> None:
    """Whatever lies at whichever depth and moves however: weights are shares; the last tiles are cut."""
    planes = [replace(plane, colour=even(0.37)) for plane in fence_scene(45)]
    result = picture(planes, 4, Settings(screen_filter=screen_filter), 45)  # type: ignore[arg-type]
    np.testing.assert_allclose(result, 0.37, rtol=1e-4)


def test_a_sharp_still_plane_is_reproduced_and_few_sharp_samples_are_not_swallowed() -> None:
    """Each pixel is the mean of its own samples: no neighbour has a say."""
    samples = sample_planes([Plane(checker(5.3))], SIZE_PX, 8)
    result = LayeredReconstruction(replace(Settings(), enough=np.inf)).reconstruct(samples, LENS).rgb
    np.testing.assert_allclose(result, samples.raw_picture(), atol=1e-5)
    aligned = [Plane(checker(16.0))]
    assert psnr(picture(aligned, 8), truth(aligned, SIZE_PX, 64)) > 90.0, "no pixel mixes, so the noise of samples has no say"
    # A sharp wire before a far wall: by the width of the common filter alone the two would merge.
    wire = Plane(even(1.0), 0.0, covers=lambda x, _: np.abs(x - 20.5) < 0.5)
    result = picture([wire, Plane(even(0.0), 24.0)], 8)
    np.testing.assert_allclose(result[:, 20], 1.0, atol=1e-3)
    np.testing.assert_allclose(result[:, [17, 18, 22, 23]], 0.0, atol=1e-3)


@pytest.mark.parametrize(
    ("planes", "gain_db"),
    [
        pytest.param((Plane(checker(12.0, angle_rad=0.3), motion_px=(14.0, 9.0)),), 9.0, marks=pytest.mark.slow),
        pytest.param((Plane(checker(12.0, angle_rad=0.3), 10.0),), 12.0, marks=pytest.mark.slow),
        pytest.param(MOVING_WAVES, 12.0, marks=pytest.mark.slow),
        (FENCE, 6.0),
    ],
)
def test_it_beats_the_raw_samples(planes: tuple[Plane, ...], gain_db: float) -> None:
    exact = known_truth(planes)
    samples = sample_planes(planes, SIZE_PX, 8)
    result = LayeredReconstruction().reconstruct(samples, LENS).rgb
    assert psnr(result, exact) > psnr(samples.raw_picture(), exact) + gain_db


@pytest.mark.parametrize(("screen_filter", "gain_db"), [("sheared", 3.0), ("direct", 3.0), ("texture", 2.0)])
def test_the_papers_filters_beat_the_raw_samples_where_texture_is_smooth(screen_filter: str, gain_db: float) -> None:
    exact, samples = known_truth(MOVING_WAVES), sample_planes(MOVING_WAVES, SIZE_PX, 8)
    settings = replace(PAPER, screen_filter=screen_filter)  # type: ignore[arg-type]
    result = LayeredReconstruction(settings).reconstruct(samples, LENS).rgb
    assert psnr(result, exact) > psnr(samples.raw_picture(), exact) + gain_db


@pytest.mark.slow
def test_merging_and_sparse_statistics_cost_at_most_1_db() -> None:
    for planes in (FENCE, (Plane(checker(16.0), 2.0, gradient=(0.15, 0.05)),)):
        exact, samples = known_truth(planes), sample_planes(planes, SIZE_PX, 8)
        full, full_counts = LayeredReconstruction(FULL).reconstruct_values(samples, samples.rgb, LENS)
        fast, counts = LayeredReconstruction().reconstruct_values(samples, samples.rgb, LENS)
        assert psnr(fast, exact) > psnr(full, exact) - 1.0
        assert full_counts.after == full_counts.before
        assert 1.0 <= counts.after < 0.8 * counts.before and counts.before <= full_counts.before


@pytest.mark.slow
def test_a_lamp_that_no_chosen_sample_saw_is_there() -> None:
    """One pixel of light at its own depth, 4 samples among 4096 of a tile: its light is kept."""
    lamp = Plane(even(100.0), -6.0, covers=lambda x, y: (np.abs(x - 30.5) < 0.5) & (np.abs(y - 12.5) < 0.5))
    planes = [lamp, Plane(even(0.0), 0.0)]
    light = truth(planes, SIZE_PX, 256).sum()
    for seed in range(3):
        result = LayeredReconstruction(seed=seed).reconstruct(sample_planes(planes, SIZE_PX, 8), LENS).rgb
        assert result.sum() == pytest.approx(light, rel=0.25)


@pytest.mark.slow
def test_a_resting_lamp_among_leaves_that_move_at_its_depth_stays_round() -> None:
    """By depth alone both were one partition, and the lamp was drawn out along the leaf's 40 px."""
    lamp = Plane(even(5.0), -8.0, covers=lambda x, y: (np.abs(x - 32.5) < 1.5) & (np.abs(y - 20.5) < 1.5))
    leaf = Plane(even(0.5), -8.0, motion_px=(40.0, 0.0), covers=lambda _, y: y > 26.0)
    planes = [lamp, leaf, Plane(even(0.1), 0.0)]
    exact, samples = truth(planes, SIZE_PX, 512), sample_planes(planes, SIZE_PX, 8)
    split = LayeredReconstruction().reconstruct(samples, LENS).rgb
    whole = LayeredReconstruction(Settings(motion_step_px=np.inf)).reconstruct(samples, LENS).rgb
    beside = np.s_[8:24]
    assert psnr(split[beside], exact[beside]) > psnr(whole[beside], exact[beside]) + 6.0
    assert np.abs(split[8:21, 44:] - 0.1).max() < 0.05, "beyond 11.5 + 4 px from its middle there is no light of the lamp"


@pytest.mark.slow
@pytest.mark.parametrize("at_px", [30.1, 30.5, 30.9])
def test_a_small_lamp_lies_where_it_is_within_its_pixel(at_px: float) -> None:
    """Its light is shared out among the nearest pixels; counted in one alone it would lie at 30.5, 0.4 px away."""
    lamp = Plane(even(100.0), -9.0, covers=lambda x, y: (np.abs(x - at_px) < 0.3) & (np.abs(y - 32.5) < 0.3))
    planes = [lamp, Plane(even(0.0), 0.0)]
    rgb = np.mean([LayeredReconstruction().reconstruct(sample_planes(planes, SIZE_PX, 8, seed), LENS).rgb for seed in range(4)], axis=0)
    x = np.arange(SIZE_PX) + 0.5
    assert (rgb[..., 0].sum(axis=0) * x).sum() / rgb[..., 0].sum() == pytest.approx(at_px, abs=0.15)


def test_parts_that_are_never_alike_are_all_there_and_what_is_left_out_is_as_said() -> None:
    """With next to no tolerance everything of a tile is in parts: the same picture as without any merging of parts."""
    np.testing.assert_allclose(picture(FENCE, 4, Settings(part_tolerance=1e-9)), picture(FENCE, 4, Settings(part_tolerance=0.0)), atol=1e-6)
    planes = [Plane(checker(12.0), 6.0)]
    np.testing.assert_array_equal(picture(planes, 4, replace(Settings(), motion=False)), picture(planes, 4))
    moving = [replace(planes[0], motion_px=(10.0, 0.0))]
    assert np.abs(picture(moving, 4, replace(Settings(), motion=False)) - picture(moving, 4)).max() > 0.02
    planes = [Plane(checker(4.0))]
    sharp, soft = picture(planes, 8), picture(planes, 8, replace(Settings(), sigma_x_px=1.5))
    assert soft.std() < 0.8 * sharp.std() and soft.mean() == pytest.approx(sharp.mean(), rel=0.01)


@pytest.mark.slow
def test_parts_are_merged_where_that_shows_least() -> None:
    """Bars hide a texture: in one part 9 dB are lost (the test below). With merged parts at most one of them is; coarse pixels alone,
    which an endless tolerance leaves, lie between."""
    exact, samples = known_truth(HIDDEN_BY_BARS), sample_planes(HIDDEN_BY_BARS, SIZE_PX, 16)
    whole = LayeredReconstruction(Settings(pupil_parts=1, shutter_parts=1)).reconstruct(samples, LENS).rgb
    all_parts, merged, coarse = (
        LayeredReconstruction(Settings(part_tolerance=tolerance)).reconstruct(samples, LENS).rgb
        for tolerance in (0.0, Settings().part_tolerance, 1e9)
    )
    assert psnr(merged, exact) > psnr(all_parts, exact) - 1.0
    assert psnr(merged, exact) > psnr(coarse, exact) > psnr(whole, exact) + 1.0


@pytest.mark.slow
@pytest.mark.parametrize(("parts", "gain_db"), [(2, 5.0), (4, 9.0)])
def test_what_a_fence_hides_depends_on_the_place_in_the_pupil(parts: int, gain_db: float) -> None:
    """A texture 9 px out of focus behind bars 14 px out of focus, on the same side: each place of the pupil sees other pieces of it.

    The blur within one of n x n cells is n times smaller, and the error of the product of two blurred pictures goes with its
    square: 12 dB less for each doubling of n where both vary linearly, measured 6 and 11.
    """
    exact, samples = known_truth(HIDDEN_BY_BARS), sample_planes(HIDDEN_BY_BARS, SIZE_PX, 16)
    settings = [Settings(pupil_parts=across, shutter_parts=1) for across in (1, parts)]
    paper, in_parts = (LayeredReconstruction(each).reconstruct(samples, LENS).rgb for each in settings)
    assert psnr(in_parts, exact) > psnr(paper, exact) + gain_db


def test_what_a_bar_hides_depends_on_the_time() -> None:
    """Bars and what is behind them move together, so that the same pieces are hidden at all times. A product of two pictures, each
    drawn out by the motion, knows nothing of that."""
    bars = Plane(even(0.35), -0.4, motion_px=(12.0, 0.0), covers=lambda x, _: x % 16.0 < 8.0)
    planes = [bars, Plane(lambda x, _: np.repeat(((x % 16.0) < 11.0)[:, None], 3, 1), 0.0, motion_px=(12.0, 0.0))]
    exact, samples = truth(planes, SIZE_PX, 512), sample_planes(planes, SIZE_PX, 16)
    settings = [replace(Settings(), merge=False, pupil_parts=1, shutter_parts=times) for times in (1, 4)]
    paper, in_parts = (LayeredReconstruction(each).reconstruct(samples, LENS).rgb for each in settings)
    assert psnr(in_parts, exact) > psnr(paper, exact) + 7.0


@pytest.mark.parametrize("wrong", [
    {"tile_px": 30}, {"coc_step_px": 0.0}, {"sigma_x_px": 0.2}, {"screen_filter": "box"}, {"merge_tolerance": 1.0},
    {"bandwidth": -1.0}, {"faint": 1.0}, {"part_tolerance": -0.1}, {"pupil_parts": 0}, {"shutter_parts": 17},
])  # fmt: skip
def test_settings_that_cannot_be_are_refused(wrong: dict) -> None:
    with pytest.raises((InputError, TypeError)):  # jaxtyping's own check, where it runs, comes first
        Settings(**wrong)


# Layers sampled first.


def test_layers_that_move_are_drawn_out_along_their_motion() -> None:
    """A pixel that moves by 8 px at one depth becomes a segment of 8 px; the ends are cut within a pixel."""
    alpha = np.zeros((SIZE_PX, SIZE_PX), np.float32)
    alpha[30, 30] = 1.0
    motion = np.dstack([8.0 * alpha, 0.0 * alpha])
    depth_m = np.where(alpha > 0, LENS.focus_distance_m, np.inf).astype(np.float32)
    layer = Layer(np.repeat(alpha[..., None], 3, 2), alpha, depth_m, {MOTION: motion.astype(np.float32)})
    result = LayeredReconstruction().render([layer], LENS)
    assert result.alpha.sum() == pytest.approx(1.0, rel=0.1)
    np.testing.assert_allclose(result.alpha[30, 27:34], 0.125, atol=0.03)
    assert result.alpha[[28, 32]].sum() < 0.02 and result.alpha[30, [24, 36]].sum() < 0.02


def test_cat_eyes_are_refused_and_the_shutter_and_the_pupil_agree_with_samples_of_the_same_scene() -> None:
    texture = checker(8.0, angle_rad=0.2)
    y, x = np.mgrid[:SIZE_PX, :SIZE_PX] + 0.5
    rgb = texture(x.ravel(), y.ravel()).reshape(SIZE_PX, SIZE_PX, 3).astype(np.float32)
    depth_m = np.full((SIZE_PX, SIZE_PX), 1.0 / (1.0 / LENS.focus_distance_m - 7.0 / LENS.coc_px_per_dioptre(SIZE_PX)), np.float32)
    motion = np.full((SIZE_PX, SIZE_PX, 2), (5.0, -3.0), np.float32)
    result = LayeredReconstruction().render([replace(opaque(rgb, depth_m), extra={MOTION: motion})], LENS).rgb
    exact = truth([Plane(texture, 7.0, motion_px=(5.0, -3.0))], SIZE_PX, 512)
    inside = np.s_[8:-8, 8:-8]
    assert psnr(result[inside], exact[inside]) > 35.0
    lens = replace(LENS, aperture=replace(Aperture.disc(), cat_eye=0.5))
    layer = opaque(np.ones((8, 8, 3), np.float32), np.full((8, 8), 2.0, np.float32))
    with pytest.raises(InputError, match="cat_eye"):
        LayeredReconstruction().render([layer], lens)
