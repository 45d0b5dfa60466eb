"""Layered reconstruction: how samples become buckets, sums and partitions, and what filter follows from the sums of a partition."""

import numpy as np
import pytest

from mrbokeh.renderers.layered_reconstruction import LayeredReconstruction, Settings
from mrbokeh.renderers.layered_reconstruction._filter_numba import axes, morton, sheared_axes, sheared_filter, tile_order
from mrbokeh.renderers.layered_reconstruction._partitions_numba import partitions_of_tile, seeded, xorshift
from mrbokeh.renderers.layered_reconstruction._samples import bucket_of, motion_cells
from mrbokeh.renderers.layered_reconstruction._tile_data import Choice, Light, Partitions
from tests.support.sampled_planes import LENS, Plane, even, sample_planes

SIZE_PX = 64
WINDOW = np.array([0.25, 0.0, 0.25, 1.0 / 12.0])
FULL = Settings(merge=False, sparse_statistics=False, faint=0.0)
"""Every bucket is a partition of its own."""


def one_tile(slopes: np.ndarray, bucket: np.ndarray | None = None, cells_x: int = 1, cells: int = 1, depths: int = 40) -> Light:
    """A picture of one tile whose samples all lie in its first block."""
    count = len(slopes)
    starts = np.full(17, count)
    starts[0] = 0
    where = np.zeros(count, np.int32) if bucket is None else bucket.astype(np.int32)
    empty = np.zeros((count, 5), np.float32), slopes.astype(np.float32), np.zeros((count, 3), np.float32)
    return Light(*empty, where, starts, 1, 32, cells_x, cells, depths, WINDOW, 1.0, 1.0)


def choice_of(settings: Settings, every: int) -> Choice:
    return LayeredReconstruction(settings)._choice(1.0)._replace(every=every)


def no_places(light: Light) -> np.ndarray:
    return np.full(light.depths * light.cells, -1, np.int32)


def buckets_of(light: Light, every: int) -> Partitions:
    return partitions_of_tile(0, light, choice_of(FULL, every), no_places(light))[0]


def sums_of(slopes: np.ndarray) -> np.ndarray:
    return buckets_of(one_tile(slopes), 1).sums[0]


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


def test_one_blur_and_one_motion_are_sheared_out_whole_and_slopes_to_all_sides_cancel() -> None:
    """Without spread of slopes everything is reprojected and the Gaussian has the second moments of disc and segment."""
    a, b_x, b_y, v_xx, v_xy, v_yy = sheared_filter(sums_of(np.tile([6.0, 9.0, -3.0], (50, 1))), WINDOW, 0.33, 1.0)
    assert (a, b_x, b_y) == pytest.approx((6.0, 9.0, -3.0))
    assert v_xx == pytest.approx(0.33**2 + 36.0 / 4.0 + 81.0 / 12.0)
    assert v_xy == pytest.approx(-27.0 / 12.0)
    assert v_yy == pytest.approx(0.33**2 + 36.0 / 4.0 + 9.0 / 12.0)
    slopes = np.array([[8.0, 20.0, 0.0], [-8.0, -20.0, 0.0]] * 20)
    a, b_x, b_y, v_xx, _, v_yy = sheared_filter(sums_of(slopes), WINDOW, 0.33, 1.0)
    assert (a, b_x, b_y) == pytest.approx((0.0, 0.0, 0.0)) and (v_xx, v_yy) == pytest.approx((0.33**2, 0.33**2))


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


# Statistics, buckets and order.


def test_morton_order_interleaves_bits_and_samples_are_sorted_by_tile_and_pixel() -> None:
    assert [morton(x, y) for y in (0, 1) for x in (0, 1, 2, 3)] == [0, 1, 4, 5, 2, 3, 6, 7]
    samples = sample_planes([Plane(even(0.5))], 40, 2)
    order, starts = np.empty(samples.count, np.int64), np.empty(25 * 16 + 1, np.int64)
    tile_order(samples.xy_px, 40, 40, 8, order, starts)
    np.testing.assert_array_equal(np.sort(order), np.arange(samples.count))
    np.testing.assert_array_equal(starts, np.arange(25 * 16 + 1) * 8)
    x, y = (each[order] for each in samples.pixels())
    codes = np.array([morton(a, b) for a, b in zip(x % 8, y % 8, strict=True)]) + (y // 8 * 5 + x // 8) * 64
    assert (np.diff(codes) >= 0).all()
    # The first number from the seed 2463534242 with the triple (13, 17, 5), Xorshift RNGs (2003), section 3.
    assert xorshift(2463534242) == 723471715
    assert len({seeded(0, tile) for tile in range(1000)}) == 1000


def test_sparse_statistics_take_one_of_every_so_many_and_sum_lonely_buckets_over_all() -> None:
    slopes = np.column_stack([np.arange(1000) // 100, np.zeros((1000, 2))]).astype(np.float32)
    sums = buckets_of(one_tile(slopes), 10).sums
    assert sums[0, 0] == 100 and sums[0, 1] == 10 * sum(range(10)), "stratified: ten from every hundred"
    # 3 of 1000 samples have a bucket of their own: it is there whatever is chosen, and weighs about as the chosen ones do.
    bucket = np.zeros(1000)
    bucket[[17, 500, 501]] = 7
    slopes = np.column_stack([bucket, np.zeros((1000, 2))])
    found = buckets_of(one_tile(slopes, bucket), 100)
    sums = found.sums
    assert found.first.tolist() == [0, 7]
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


@pytest.mark.parametrize(("radius_px", "light", "is_faint"), [(20.0, 1.0, True), (20.0, 100.0, False), (0.0, 1.0, False)])
def test_what_can_hardly_be_seen_has_no_partition(radius_px: float, light: float, is_faint: bool) -> None:
    """3 of 1000 samples, at one a pixel, moving by 20 px: spread over a disc of 20 px they hide 0.2 % of what is behind, over their
    path alone an eighth, and as lamps of 100 they add 0.2 of the light of all. A faint one joins the partition of its slopes, not the
    one just in front of it, and leaves that partition's filter alone."""
    few = np.arange(1000) % 400 == 7
    slopes = np.column_stack([np.where(few, radius_px, -9.0), np.where(few, 20.0, 0.0), np.zeros(1000)])
    slopes[:300] = (19.0, 20.0, 0.0)
    slopes[few] = (radius_px, 20.0, 0.0)
    bucket = np.where(np.arange(1000) < 300, 30, 5)
    bucket[few] = 8
    values = np.where(few, light, 1.0)[:, None].repeat(3, 1).astype(np.float32)
    tile = one_tile(slopes, bucket)._replace(values=values)
    partitions, _, populated = partitions_of_tile(0, tile, choice_of(Settings(), 1), place := no_places(tile))
    assert populated == 3 and len(partitions.sums) == (2 if is_faint else 3)
    assert place[8] == 2 and place[30] == (2 if is_faint else 4)
    assert partitions.sums[-1, 0] == (np.arange(1000) < 300).sum() - few[:300].sum()


def test_cells_of_motion_have_the_side_asked_for_and_where_all_is_faint_nothing_is() -> None:
    motion_px = np.random.default_rng(0).uniform(-40.0, 40.0, (2000, 2)).astype(np.float32)
    cell, across, count = motion_cells(motion_px, Settings(motion_step_px=16.0))
    assert cell.min() >= 0 and cell.max() < count and count % across == 0
    assert max(np.ptp(motion_px[cell == index], axis=0).max() for index in np.unique(cell)) <= 16.0
    assert motion_cells(motion_px, Settings(motion=False))[2] == 1
    slopes = np.tile([30.0, 0.0, 0.0], (2, 1))
    light = one_tile(slopes, np.array([3, 9]))
    partitions, _, _ = partitions_of_tile(0, light, choice_of(Settings(), 1), no_places(light))
    assert len(partitions.sums) >= 1 and partitions.sums[:, 0].sum() == 2


def test_buckets_cut_depth_finely_near_the_focus_and_infinity_is_the_last() -> None:
    depth_m = np.linspace(0.3, 3.0, 5000).astype(np.float32)
    coc_px = LENS.coc_px(depth_m, SIZE_PX).astype(np.float32)
    bucket, count = bucket_of(coc_px, depth_m, Settings())
    assert (np.diff(bucket) >= 0).all() and bucket[0] == 0 and bucket[-1] == count - 1
    for index in np.unique(bucket):
        inside = coc_px[bucket == index]
        assert np.ptp(inside) <= 0.5 + 1e-4 or inside.min() > 64.0 - 0.5 or inside.max() < -64.0 + 0.5
        # The first and the last hold 1 % of 2.7 m more, beyond the percentiles.
        assert np.ptp(depth_m[bucket == index]) <= (2.973 - 0.327) / 128 + 0.028
    depth_m = np.array([1.0, 1.0, 2.0, 5.0, np.inf], np.float32)
    bucket, _ = bucket_of(np.zeros(5, np.float32), depth_m, Settings())
    assert bucket[0] == bucket[1] < bucket[2] < bucket[3] < bucket[4]
