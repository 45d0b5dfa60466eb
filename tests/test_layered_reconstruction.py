"""Layered reconstruction: its filters against their definitions, its pictures against many samples of scenes with known truth."""

import math
from dataclasses import replace

import numpy as np
import pytest
from scipy.special import erf

from mrbokeh.aperture import Aperture
from mrbokeh.errors import InputError
from mrbokeh.image_metrics import psnr
from mrbokeh.layer import Layer, opaque
from mrbokeh.light_field_samples import LightFieldSamples
from mrbokeh.motion import MOTION
from mrbokeh.renderers.layered_reconstruction import LayeredReconstruction, Settings, footprint_sigmas
from mrbokeh.renderers.layered_reconstruction._buckets import bucket_of, motion_cells
from mrbokeh.renderers.layered_reconstruction._direct_gaussian_numba import direct_gaussian
from mrbokeh.renderers.layered_reconstruction._filter_numba import axes, sheared_axes, sheared_filter
from mrbokeh.renderers.layered_reconstruction._partitions_numba import partitions_of_tile
from mrbokeh.renderers.layered_reconstruction._pupil_spans import pupil_spans
from mrbokeh.renderers.layered_reconstruction._samples_numba import morton, tile_order
from mrbokeh.renderers.layered_reconstruction._sheared_gaussian_numba import recursive_rows, sheared_gaussian
from mrbokeh.renderers.layered_reconstruction._statistics_numba import rows_of_tile, seeded, xorshift
from mrbokeh.renderers.layered_reconstruction._texture_gaussian_numba import texture_gaussian
from mrbokeh.renderers.layered_reconstruction._tile_data import Choice, Light
from mrbokeh.renderers.layered_reconstruction._window_numba import line_taps, window_filter, window_guards
from tests.sampled_planes import LENS, Plane, checker, even, fence_scene, sample_planes, truth, waves

SIZE_PX = 64
WINDOW = np.array([0.25, 0.0, 0.25, 1.0 / 12.0])
PAPER = Settings(screen_filter="sheared", recursive_passes=1, enough=np.inf)
FULL = Settings(merge=False, sparse_statistics=False)


def picture(planes: list[Plane], per_pixel: int, settings: Settings | None = None, size_px: int = SIZE_PX) -> np.ndarray:
    samples = sample_planes(planes, size_px, per_pixel)
    return LayeredReconstruction(settings or Settings()).reconstruct(samples, LENS).rgb


def one_tile(slopes: np.ndarray, bucket: np.ndarray | None = None, cells_x: int = 1, cells: int = 1, depths: int = 40) -> Light:
    """A picture of one tile whose samples all lie in its first block."""
    count = len(slopes)
    starts = np.full(17, count)
    starts[0] = 0
    where = np.zeros(count, np.int32) if bucket is None else bucket.astype(np.int32)
    empty = np.zeros((count, 5), np.float32), slopes.astype(np.float32), np.zeros((count, 3), np.float32)
    return Light(*empty, where, starts, 1, 32, cells_x, cells, depths, WINDOW, 1.0)


def choice_of(settings: Settings, every: int) -> Choice:
    return LayeredReconstruction(settings)._choice(1.0)._replace(every=every)


def no_places(light: Light) -> np.ndarray:
    return np.full(light.depths * light.cells, -1, np.int32)


def sums_of(slopes: np.ndarray) -> np.ndarray:
    light = one_tile(slopes)
    return rows_of_tile(0, light, choice_of(FULL, 1), no_places(light))[1][0]


# The filter of a partition.


@pytest.mark.parametrize("sigmas", [(1.0, 1.0), (10.0, 0.33), (6.0, 4.0), (0.5, 0.4)])
@pytest.mark.parametrize("theta", [0.0, 0.03, 0.7, np.pi / 2, 2.2, -1.1])
def test_the_sheared_gaussian_is_the_rotated_one(sigmas: tuple[float, float], theta: float) -> None:
    """B B^T = A A^T (Eq. 5 to 9)."""
    turn = np.array([[np.cos(theta), -np.sin(theta)], [np.sin(theta), np.cos(theta)]])
    rotated = turn @ np.diag(sigmas)
    s_u, s_v, beta = sheared_axes(*sigmas, theta)
    sheared = np.array([[1.0, beta], [0.0, 1.0]]) @ np.diag([s_u, s_v])
    np.testing.assert_allclose(sheared @ sheared.T, rotated @ rotated.T, atol=1e-9 * max(sigmas) ** 2)
    np.testing.assert_allclose(axes(*(rotated @ rotated.T)[[0, 0, 1], [0, 1, 1]])[:2], sorted(sigmas, reverse=True), rtol=1e-6)


def test_alpha_is_where_a_square_holds_95_percent() -> None:
    """Eq. 3; the paper rounds it to 2.24."""
    alpha = footprint_sigmas(0.95)
    assert alpha == pytest.approx(2.236, abs=5e-4)
    assert erf(alpha / np.sqrt(2.0)) ** 2 == pytest.approx(0.95, abs=1e-12)


def test_one_blur_and_one_motion_are_sheared_out_whole() -> None:
    """Without spread of slopes everything is reprojected and the Gaussian has the second moments of disc and segment."""
    a, b_x, b_y, v_xx, v_xy, v_yy = sheared_filter(sums_of(np.tile([6.0, 9.0, -3.0], (50, 1))), WINDOW, 0.33, 1.0)
    assert (a, b_x, b_y) == pytest.approx((6.0, 9.0, -3.0))
    assert v_xx == pytest.approx(0.33**2 + 36.0 / 4.0 + 81.0 / 12.0)
    assert v_xy == pytest.approx(-27.0 / 12.0)
    assert v_yy == pytest.approx(0.33**2 + 36.0 / 4.0 + 9.0 / 12.0)


def test_mixed_slopes_are_trusted_less_but_blur_as_much() -> None:
    """What the samples keep of their own blur and what the Gaussian adds is together the mean blur, whatever the share."""
    rng = np.random.default_rng(0)
    slopes = np.column_stack([rng.normal(5.0, 2.0, 4000), rng.normal(8.0, 4.0, 4000), rng.normal(2.0, 4.0, 4000)])
    sums = sums_of(slopes)
    r, m_x, m_y = slopes.mean(axis=0)
    previous = (r, m_x)
    for bandwidth in (0.5, 1.0, 2.0):
        a, b_x, b_y, v_xx, v_xy, v_yy = sheared_filter(sums, WINDOW, 0.33, bandwidth)
        assert 0 < a < previous[0] and 0 < b_x < previous[1]
        previous = a, b_x
        assert v_xx - 0.33**2 + ((r - a) ** 2 / 4 + (m_x - b_x) ** 2 / 12) == pytest.approx(r**2 / 4 + m_x**2 / 12, rel=1e-4)
        assert v_xy + (m_x - b_x) * (m_y - b_y) / 12 == pytest.approx(m_x * m_y / 12, rel=1e-3)
        assert v_xx * v_yy > v_xy**2


def test_slopes_to_all_sides_cancel_to_plain_averaging() -> None:
    slopes = np.array([[8.0, 20.0, 0.0], [-8.0, -20.0, 0.0]] * 20)
    a, b_x, b_y, v_xx, _, v_yy = sheared_filter(sums_of(slopes), WINDOW, 0.33, 1.0)
    assert (a, b_x, b_y) == pytest.approx((0.0, 0.0, 0.0)) and (v_xx, v_yy) == pytest.approx((0.33**2, 0.33**2))


# Screen-space filters.


def impulse(size_px: int) -> np.ndarray:
    planes = np.zeros((size_px, size_px, 1), np.float32)
    planes[size_px // 2, size_px // 2] = 1.0
    return planes


def moments(kernel: np.ndarray) -> tuple[float, float, float, float]:
    """Sum and second moments xx, xy, yy about the middle."""
    kernel = kernel[..., 0].astype(np.float64)
    y, x = np.indices(kernel.shape) - (np.array(kernel.shape)[:, None, None] // 2)
    return kernel.sum(), *(float((kernel * each).sum() / kernel.sum()) for each in (x * x, x * y, y * y))


@pytest.mark.parametrize("variance_px2", [0.3, 1.0, 9.0, 100.0])
@pytest.mark.parametrize("passes", [1, 2, 3])
def test_the_recursive_filter_keeps_light_and_has_the_variance_asked_for(variance_px2: float, passes: int) -> None:
    row = np.zeros((1, 401, 1), np.float32)
    row[0, 200] = 1.0
    recursive_rows(row, variance_px2, passes)
    at = np.arange(401) - 200
    assert row.sum() == pytest.approx(1.0, rel=1e-4)
    assert (row[0, :, 0].astype(np.float64) * at**2).sum() == pytest.approx(variance_px2, rel=1e-3)
    np.testing.assert_allclose(row[0, :, 0], row[0, ::-1, 0], atol=1e-7)


def test_the_feedback_is_the_papers_for_wide_filters() -> None:
    """Eq. 10: gamma = exp(-sqrt(2) / sigma); 1 % away at 10 px, and exact in variance at any width (the test above)."""
    from mrbokeh.renderers.layered_reconstruction._sheared_gaussian_numba import feedback

    assert feedback(100.0) == pytest.approx(math.exp(-math.sqrt(2.0) / 10.0), rel=1e-3)


COVARIANCES = [(9.0, 0.0, 9.0), (25.0, 0.0, 2.0), (12.0, 8.0, 9.0), (2.0, -1.5, 16.0)]


@pytest.mark.parametrize("v", COVARIANCES)
def test_the_sheared_filter_is_the_direct_gaussian(v: tuple[float, float, float]) -> None:
    """Second moments within 4 % (the guard band cuts both), and the shape the nearer, the more passes."""
    guard, size = 18, 37
    direct, errors = np.empty((size, size, 1), np.float32), []
    direct_gaussian(direct, impulse(size + 2 * guard), guard, guard, *v)
    for passes in (1, 3):
        out = np.empty_like(direct)
        sheared_gaussian(out, impulse(size + 2 * guard), guard, guard, *v, passes)
        errors.append(float(np.abs(out - direct).sum()))
        if passes == 3:
            np.testing.assert_allclose(moments(out), moments(direct), rtol=0.04, atol=0.05)
    assert errors[1] < 0.6 * errors[0] and errors[1] < 0.2, "share of the light that lies elsewhere"


@pytest.mark.parametrize("v", COVARIANCES)
def test_four_look_ups_come_nearer_to_the_gaussian_than_one(v: tuple[float, float, float]) -> None:
    """Averaged over where the texels of the mip map lie, for a look-up is not the same everywhere."""
    guard, size = 24, 49
    direct = np.empty((size, size, 1), np.float32)
    direct_gaussian(direct, impulse(size + 2 * guard), guard, guard, *v)
    errors = {}
    for taps in (1, 4):
        mean = np.zeros((size, size))
        for shift in np.ndindex(4, 4):
            planes = np.roll(impulse(size + 2 * guard), shift, (0, 1))
            out = np.empty_like(direct)
            texture_gaussian(out, planes, guard, guard, *axes(*v), footprint_sigmas(0.95), 0.33, taps)
            mean += np.roll(out[..., 0], (-shift[0], -shift[1]), (0, 1)) / 16.0
        errors[taps] = float(np.abs(mean - direct[..., 0]).sum())
        assert mean.sum() == pytest.approx(1.0, abs=0.02)
    assert errors[4] < errors[1] if v[0] == v[2] else errors[4] < 0.6
    assert errors[4] < 0.6


@pytest.mark.parametrize("v", [(9.0, 0.0, 9.0), (25.0, 0.0, 2.0), (60.0, 0.0, 4.0)])
def test_a_look_up_is_as_wide_along_both_axes(v: tuple[float, float, float]) -> None:
    """A box of the width w = alpha sigma and the tent of the interpolation have w^2/4 = 1.25 sigma^2; trilinear blends of two
    levels more, by the ratio of their widths. Four look-ups are scaled to sigma^2."""
    guard, size, alpha = 40, 81, footprint_sigmas(0.95)
    for taps, expected in ((1, alpha**2 / 4), (4, 1.0)):
        mean = np.zeros((size, size, 1))
        for shift in np.ndindex(8, 8):
            out = np.empty((size, size, 1), np.float32)
            texture_gaussian(out, np.roll(impulse(size + 2 * guard), shift, (0, 1)), guard, guard, *axes(*v), alpha, 0.33, taps)
            mean += np.roll(out, (-shift[0], -shift[1]), (0, 1)) / 64.0
        total, along, _, across = moments(mean)
        assert total == pytest.approx(1.0, abs=0.02)
        assert along / v[0] == pytest.approx(expected, rel=0.2) and across / v[2] == pytest.approx(expected, rel=0.25)


@pytest.mark.parametrize("scale", [-5.3, 1.7, 9.0])
@pytest.mark.parametrize("length", [(0.0, 0.0), (7.0, 3.0), (-4.0, 11.5)])
def test_the_window_filter_is_chance_through_pupil_and_shutter(scale: float, length: tuple[float, float]) -> None:
    """Its slow twin: 400 000 places in a heart-shaped pupil and the shutter, and which pixel each of them reads."""
    rng, heart = np.random.default_rng(1), Aperture.heart()
    spans = pupil_spans(heart, 64)
    guards = window_guards(scale, heart.unit_radius, *length, 0.0)
    guard_x, guard_y = guards[0] + guards[2], guards[1] + guards[2]
    out, planes = np.empty((41, 41, 1), np.float32), np.zeros((41 + 2 * guard_y, 41 + 2 * guard_x, 1), np.float32)
    planes[20 + guard_y, 20 + guard_x] = 1.0
    window_filter(out, planes, spans, scale, *length, 0.0, guards)
    chosen = spans[rng.choice(len(spans), 400_000, p=spans[:, 3])]
    height = np.ptp(heart.outlines[0][:, 1]) / 64
    u = chosen[:, 1] + rng.uniform(size=400_000) * (chosen[:, 2] - chosen[:, 1])
    v = chosen[:, 0] + (rng.uniform(size=400_000) - 0.5) * height
    t = rng.uniform(-0.5, 0.5, 400_000)
    off_x = np.floor(0.5 + scale * u) + np.floor(0.5 + length[0] * t)
    off_y = np.floor(0.5 + scale * v) + np.floor(0.5 + length[1] * t)
    thrown, _, _ = np.histogram2d(off_y, off_x, bins=np.arange(-20.5, 21.0))
    assert np.abs(out[..., 0] - thrown / thrown.sum()).sum() < 0.03, "what chance over two hundred pixels leaves"
    assert out.sum() == pytest.approx(1.0, abs=1e-4)


def test_a_segment_is_shared_out_by_length() -> None:
    """Of a segment of 3 px along x one third lies in each of three pixels; of one of 2 px half in the middle, a quarter beside."""
    for length, expected in ((3.0, [1 / 3, 1 / 3, 1 / 3]), (2.0, [0.25, 0.5, 0.25]), (0.0, [1.0])):
        offsets, weights = line_taps(length, 0.0)
        np.testing.assert_allclose(weights, expected, atol=1e-6)
        np.testing.assert_array_equal(offsets[:, 0], np.arange(len(expected)) - len(expected) // 2)


# Statistics, buckets and order.


def test_morton_order_interleaves_bits() -> None:
    assert [morton(x, y) for y in (0, 1) for x in (0, 1, 2, 3)] == [0, 1, 4, 5, 2, 3, 6, 7]


def test_samples_are_sorted_by_tile_and_pixel() -> None:
    samples = sample_planes([Plane(even(0.5))], 40, 2)
    order, starts = np.empty(samples.count, np.int64), np.empty(25 * 16 + 1, np.int64)
    tile_order(samples.xy_px, 40, 40, 8, order, starts)
    np.testing.assert_array_equal(np.sort(order), np.arange(samples.count))
    np.testing.assert_array_equal(starts, np.arange(25 * 16 + 1) * 8)
    x, y = (each[order] for each in samples.pixels())
    codes = np.array([morton(a, b) for a, b in zip(x % 8, y % 8, strict=True)]) + (y // 8 * 5 + x // 8) * 64
    assert (np.diff(codes) >= 0).all()


def test_xorshift_is_marsaglias() -> None:
    """The first number from the seed 2463534242 with the triple (13, 17, 5), Xorshift RNGs (2003), section 3."""
    assert xorshift(2463534242) == 723471715
    assert len({seeded(0, tile) for tile in range(1000)}) == 1000


def test_sparse_statistics_take_one_of_every_so_many() -> None:
    slopes = np.column_stack([np.arange(1000) // 100, np.zeros((1000, 2))]).astype(np.float32)
    light = one_tile(slopes)
    _, sums = rows_of_tile(0, light, choice_of(FULL, 10), no_places(light))
    assert sums[0, 0] == 100 and sums[0, 1] == 10 * sum(range(10)), "stratified: ten from every hundred"


def test_a_bucket_that_no_chosen_sample_saw_is_summed_over_all() -> None:
    """3 of 1000 samples have a bucket of their own: it is there whatever is chosen, and weighs about as the chosen ones do."""
    bucket = np.zeros(1000)
    bucket[[17, 500, 501]] = 7
    slopes = np.column_stack([bucket, np.zeros((1000, 2))])
    light = one_tile(slopes, bucket)
    buckets, sums = rows_of_tile(0, light, choice_of(FULL, 100), no_places(light))
    assert buckets.tolist() == [0, 7]
    assert sums[1, 1] / sums[1, 0] == 7.0 and 0.03 <= sums[1, 0] <= 2


def test_motions_at_one_depth_become_partitions_and_every_bucket_has_its_place() -> None:
    """Depth 5 holds what rests and what moves by 30 px; depth 20 rests. Between them is nothing, behind nobody knows."""
    moves, far = np.arange(100) % 2 == 1, np.arange(100) >= 80
    slopes = np.column_stack([np.where(far, 12.0, 4.0), np.where(moves & ~far, 30.0, 0.0), np.zeros(100)])
    bucket = np.where(far, 20, 5) * 3 + np.where(moves & ~far, 2, 0)
    light = one_tile(slopes, bucket, cells_x=3, cells=3)
    partitions, touched, populated = partitions_of_tile(0, light, choice_of(Settings(), 1), place := no_places(light))
    assert populated == 3 and len(partitions.sums) == 3
    assert partitions.first.tolist() == [5, 5, 20]
    assert [place[5 * 3], place[5 * 3 + 2], place[20 * 3]] == [0, 2, 4]
    assert place[4 * 3] == place[6 * 3] == 0 and place[4 * 3 + 2] == 2, "free neighbours go with them"
    assert [partitions.gaps[depth] for depth in (0, 10, 30)] == [-1, 3, 5]
    place[touched] = -1
    assert (place == -1).all()


def test_cells_of_motion_have_the_side_asked_for() -> None:
    motion_px = np.random.default_rng(0).uniform(-40.0, 40.0, (2000, 2)).astype(np.float32)
    cell, across, count = motion_cells(motion_px, Settings(motion_step_px=16.0))
    assert cell.min() >= 0 and cell.max() < count and count % across == 0
    assert max(np.ptp(motion_px[cell == index], axis=0).max() for index in np.unique(cell)) <= 16.0
    assert motion_cells(motion_px, Settings(motion=False))[2] == 1


def test_buckets_grow_with_depth_and_cut_it_finely_near_the_focus() -> None:
    depth_m = np.linspace(0.3, 3.0, 5000).astype(np.float32)
    coc_px = LENS.coc_px(depth_m, SIZE_PX).astype(np.float32)
    bucket, count = bucket_of(coc_px, depth_m, Settings())
    assert (np.diff(bucket) >= 0).all() and bucket[0] == 0 and bucket[-1] == count - 1
    for index in np.unique(bucket):
        inside = coc_px[bucket == index]
        assert np.ptp(inside) <= 0.5 + 1e-4 or inside.min() > 64.0 - 0.5 or inside.max() < -64.0 + 0.5
        # The first and the last hold 1 % of 2.7 m more, beyond the percentiles.
        assert np.ptp(depth_m[bucket == index]) <= (2.973 - 0.327) / 128 + 0.028


def test_without_defocus_depth_alone_makes_buckets_and_infinity_is_the_last() -> None:
    depth_m = np.array([1.0, 1.0, 2.0, 5.0, np.inf], np.float32)
    bucket, _ = bucket_of(np.zeros(5, np.float32), depth_m, Settings())
    assert bucket[0] == bucket[1] < bucket[2] < bucket[3] < bucket[4]


# Pictures.


@pytest.mark.parametrize("screen_filter", ["windows", "sheared", "texture", "texture_one_tap", "direct"])
def test_an_even_light_field_stays_even(screen_filter: str) -> None:
    """Whatever lies at whichever depth and moves however: weights are shares."""
    planes = [replace(plane, colour=even(0.37)) for plane in fence_scene(SIZE_PX)]
    result = picture(planes, 4, Settings(screen_filter=screen_filter))  # type: ignore[arg-type]
    np.testing.assert_allclose(result, 0.37, rtol=1e-4)


def test_a_sharp_still_plane_is_reproduced() -> None:
    """Each pixel is the mean of its own samples: no neighbour has a say."""
    samples = sample_planes([Plane(checker(5.3))], SIZE_PX, 8)
    result = LayeredReconstruction(replace(Settings(), enough=np.inf)).reconstruct(samples, LENS).rgb
    np.testing.assert_allclose(result, samples.raw_picture(), atol=1e-5)
    aligned = [Plane(checker(16.0))]
    assert psnr(picture(aligned, 8), truth(aligned, SIZE_PX, 64)) > 90.0, "no pixel mixes, so the noise of samples has no say"


@pytest.mark.parametrize(
    ("planes", "gain_db"),
    [
        ([Plane(checker(12.0, angle_rad=0.3), motion_px=(14.0, 9.0))], 9.0),
        ([Plane(checker(12.0, angle_rad=0.3), 10.0)], 12.0),
        ([Plane(waves(20.0), 8.0, motion_px=(6.0, 2.0))], 12.0),
        (fence_scene(SIZE_PX), 6.0),
    ],
)
def test_it_beats_the_raw_samples(planes: list[Plane], gain_db: float) -> None:
    exact = truth(planes, SIZE_PX)
    samples = sample_planes(planes, SIZE_PX, 8)
    result = LayeredReconstruction().reconstruct(samples, LENS).rgb
    assert psnr(result, exact) > psnr(samples.raw_picture(), exact) + gain_db


@pytest.mark.parametrize(("screen_filter", "gain_db"), [("sheared", 3.0), ("direct", 3.0), ("texture", 2.0)])
def test_the_papers_filters_beat_the_raw_samples_where_texture_is_smooth(screen_filter: str, gain_db: float) -> None:
    planes = [Plane(waves(20.0), 8.0, motion_px=(6.0, 2.0))]
    exact, samples = truth(planes, SIZE_PX), sample_planes(planes, SIZE_PX, 8)
    settings = replace(PAPER, screen_filter=screen_filter)  # type: ignore[arg-type]
    result = LayeredReconstruction(settings).reconstruct(samples, LENS).rgb
    assert psnr(result, exact) > psnr(samples.raw_picture(), exact) + gain_db


def test_merging_and_sparse_statistics_cost_at_most_1_db() -> None:
    for planes in (fence_scene(SIZE_PX), [Plane(checker(16.0), 2.0, gradient=(0.15, 0.05))]):
        exact, samples = truth(planes, SIZE_PX, 512), sample_planes(planes, SIZE_PX, 8)
        full, full_counts = LayeredReconstruction(FULL).reconstruct_counted(samples, LENS)
        fast, counts = LayeredReconstruction().reconstruct_counted(samples, LENS)
        assert psnr(fast, exact) > psnr(full, exact) - 1.0
        assert full_counts.after == full_counts.before
        assert 1.0 <= counts.after < 0.8 * counts.before and counts.before <= full_counts.before


def test_a_few_sharp_samples_are_not_swallowed_by_the_blurred_many_behind() -> None:
    """A sharp wire before a far wall: by the width of the common filter alone the two would merge."""
    wire = Plane(even(1.0), 0.0, covers=lambda x, _: np.abs(x - 20.5) < 0.5)
    result = picture([wire, Plane(even(0.0), 24.0)], 8)
    np.testing.assert_allclose(result[:, 20], 1.0, atol=1e-3)
    np.testing.assert_allclose(result[:, [17, 18, 22, 23]], 0.0, atol=1e-3)


def test_a_lamp_that_no_chosen_sample_saw_is_there() -> None:
    """One pixel of light at its own depth, 4 samples among 4096 of a tile: its light is kept."""
    lamp = Plane(even(100.0), -6.0, covers=lambda x, y: (np.abs(x - 30.5) < 0.5) & (np.abs(y - 12.5) < 0.5))
    planes = [lamp, Plane(even(0.0), 0.0)]
    light = truth(planes, SIZE_PX).sum()
    for seed in range(3):
        result = LayeredReconstruction(seed=seed).reconstruct(sample_planes(planes, SIZE_PX, 8), LENS).rgb
        assert result.sum() == pytest.approx(light, rel=0.25)


def test_a_resting_lamp_among_leaves_that_move_at_its_depth_stays_round() -> None:
    """By depth alone both were one partition, and the lamp was drawn out along the leaf's 40 px."""
    lamp = Plane(even(5.0), -8.0, covers=lambda x, y: (np.abs(x - 32.5) < 1.5) & (np.abs(y - 20.5) < 1.5))
    leaf = Plane(even(0.5), -8.0, motion_px=(40.0, 0.0), covers=lambda _, y: y > 26.0)
    planes = [lamp, leaf, Plane(even(0.1), 0.0)]
    exact, samples = truth(planes, SIZE_PX), sample_planes(planes, SIZE_PX, 8)
    split = LayeredReconstruction().reconstruct(samples, LENS).rgb
    whole = LayeredReconstruction(Settings(motion_step_px=np.inf)).reconstruct(samples, LENS).rgb
    beside = np.s_[8:24]
    assert psnr(split[beside], exact[beside]) > psnr(whole[beside], exact[beside]) + 6.0
    assert np.abs(split[8:21, 44:] - 0.1).max() < 0.05, "beyond 11.5 + 4 px from its middle there is no light of the lamp"


@pytest.mark.parametrize("at_px", [30.1, 30.5, 30.9])
def test_a_small_lamp_lies_where_it_is_within_its_pixel(at_px: float) -> None:
    """Its light is shared out among the nearest pixels; counted in one alone it would lie at 30.5, 0.4 px away."""
    lamp = Plane(even(100.0), -9.0, covers=lambda x, y: (np.abs(x - at_px) < 0.3) & (np.abs(y - 32.5) < 0.3))
    planes = [lamp, Plane(even(0.0), 0.0)]
    rgb = np.mean([LayeredReconstruction().reconstruct(sample_planes(planes, SIZE_PX, 8, seed), LENS).rgb for seed in range(4)], axis=0)
    x = np.arange(SIZE_PX) + 0.5
    assert (rgb[..., 0].sum(axis=0) * x).sum() / rgb[..., 0].sum() == pytest.approx(at_px, abs=0.15)


def test_motion_left_out_is_the_same_where_nothing_moves() -> None:
    planes = [Plane(checker(12.0), 6.0)]
    np.testing.assert_array_equal(picture(planes, 4, replace(Settings(), motion=False)), picture(planes, 4))
    moving = [replace(planes[0], motion_px=(10.0, 0.0))]
    assert np.abs(picture(moving, 4, replace(Settings(), motion=False)) - picture(moving, 4)).max() > 0.02


def test_the_number_of_threads_changes_no_bit() -> None:
    samples = sample_planes(fence_scene(SIZE_PX), SIZE_PX, 4)
    one, three = (LayeredReconstruction(threads=threads).reconstruct(samples, LENS).rgb for threads in (1, 3))
    np.testing.assert_array_equal(one, three)


def test_a_wider_spatial_filter_blurs() -> None:
    planes = [Plane(checker(4.0))]
    sharp, soft = picture(planes, 8), picture(planes, 8, replace(Settings(), sigma_x_px=1.5))
    assert soft.std() < 0.8 * sharp.std() and soft.mean() == pytest.approx(sharp.mean(), rel=0.01)


@pytest.mark.parametrize(
    "wrong",
    [
        {"tile_px": 30},
        {"coc_step_px": 0.0},
        {"sigma_x_px": 0.2},
        {"screen_filter": "box"},
        {"merge_tolerance": 1.0},
        {"bandwidth": -1.0},
    ],
)
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
    result = LayeredReconstruction(per_pixel=64).render([layer], LENS)
    assert result.alpha.sum() == pytest.approx(1.0, rel=0.1)
    np.testing.assert_allclose(result.alpha[30, 27:34], 0.125, atol=0.03)
    assert result.alpha[[28, 32]].sum() < 0.02 and result.alpha[30, [24, 36]].sum() < 0.02


def test_the_shutter_and_the_pupil_of_layers_agree_with_samples_of_the_same_scene() -> None:
    texture = checker(8.0, angle_rad=0.2)
    y, x = np.mgrid[:SIZE_PX, :SIZE_PX] + 0.5
    rgb = texture(x.ravel(), y.ravel()).reshape(SIZE_PX, SIZE_PX, 3).astype(np.float32)
    depth_m = np.full((SIZE_PX, SIZE_PX), 1.0 / (1.0 / LENS.focus_distance_m - 7.0 / LENS.coc_px_per_dioptre(SIZE_PX)), np.float32)
    motion = np.full((SIZE_PX, SIZE_PX, 2), (5.0, -3.0), np.float32)
    result = LayeredReconstruction().render([replace(opaque(rgb, depth_m), extra={MOTION: motion})], LENS).rgb
    exact = truth([Plane(texture, 7.0, motion_px=(5.0, -3.0))], SIZE_PX, 512)
    inside = np.s_[8:-8, 8:-8]
    assert psnr(result[inside], exact[inside]) > 35.0


def test_cat_eyes_and_colours_are_refused() -> None:
    lens = replace(LENS, aperture=replace(Aperture.disc(), cat_eye=0.5))
    layer = opaque(np.ones((8, 8, 3), np.float32), np.full((8, 8), 2.0, np.float32))
    with pytest.raises(InputError, match="cat_eye"):
        LayeredReconstruction().render([layer], lens)


def test_samples_of_a_picture_that_is_no_multiple_of_a_tile() -> None:
    """The last tiles are cut; every pixel is still filled."""
    samples = sample_planes([Plane(even(0.6), 5.0)], 45, 4)
    cut = LightFieldSamples(45, 45, *(getattr(samples, name) for name in ("xy_px", "lens_uv", "time", "rgb", "depth_m", "motion_px")))
    np.testing.assert_allclose(LayeredReconstruction().reconstruct(cut, LENS).rgb, 0.6, rtol=1e-5)
