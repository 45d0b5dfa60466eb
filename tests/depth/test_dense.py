"""Dense depth: each step against its plain twin, the votes of focus, the whole against traced scenes."""

import dataclasses
from functools import cache
from itertools import pairwise

import numpy as np
import pytest

from capture.dense.scene_depth import on_original_pixels, patch_match_obstacle, patch_match_prior
from mrbokeh.depth.depth_filters import interpolate, smooth
from mrbokeh.depth.views._views_numba import aggregate
from mrbokeh.depth.views.dense_depth import (
    FILLED,
    FOCUS,
    SWEEP,
    DenseDepth,
    DenseSettings,
    dense_depth,
    halvings,
    level_sizes,
    sweep_trust,
    with_consistency,
)
from mrbokeh.depth.views.depth_priors import (
    SHARE_OF_FOCUS,
    Consistency,
    DepthPriors,
    FocusVote,
    SparseDepths,
    ViewDepth,
    add_focus_votes,
    agreement,
    consistency,
    focus_vote_of_map,
    near_highlights,
)
from mrbokeh.depth.views.guided_depth import (
    Penalties,
    label_planes,
    near_steps,
    weighted_medians,
)
from mrbokeh.depth.views.sweep_view import SweepView
from mrbokeh.optics.camera import Camera
from tests.support.dense_references import aggregate_reference, weighted_medians_reference
from tests.support.plane_sweep_scenes import FOCAL_PX, HEIGHT_PX, WIDTH_PX, TracedViews, card, grey_card, traced, wall

RANGE = (0.4, 1.7)
RNG = np.random.default_rng(0)


@cache
def desk() -> TracedViews:
    """A slanted wall, a card and a plain card before it, with noise."""
    return traced((wall(1.6, tilt=0.3), card(0.8, -0.1, 0.06), grey_card(1.1, 0.16, 0.34)), noise=0.01)


@cache
def desk_depth() -> DenseDepth:
    scene = desk()
    return dense_depth(scene.rgb[0], scene.views[0], scene.views[1:], RANGE)


def wrong(found: DenseDepth, scene: TracedViews) -> np.ndarray:
    """Pixels off by 0.05 dioptre: half a pixel of parallax here."""
    return np.abs(1.0 / found.depth_m - scene.dioptre) > 0.05


def test_semi_global_costs_are_those_of_the_open_loops() -> None:
    """Path costs are whole numbers but for the bent penalty, whose fraction is dropped path by path: 8 paths, at most 1 each."""
    costs = RNG.integers(0, 256, (9, 11, 7)).astype(np.uint8)
    guide = RNG.uniform(0, 1, (9, 11)).astype(np.float32)
    rules = Penalties(20.0, 150.0, 0.2)
    fast = aggregate(costs, guide, rules.small, rules.large, rules.contrast).astype(int)
    assert np.abs(fast - aggregate_reference(costs, guide, rules).astype(int)).max() <= 8


def test_planes_are_labelled_where_the_guide_and_costs_speak() -> None:
    """Costs tell the plane only at the far left and right; between them nothing but the picture says where one ends."""
    costs = np.full((12, 40, 9), 200, np.uint8)
    costs[:, :2, 2], costs[:, -2:, 6] = 0, 0
    guide = np.where(np.arange(40) < 27, 0.2, 0.7).astype(np.float32) * np.ones((12, 1), np.float32)
    labels = label_planes(costs, guide)
    np.testing.assert_array_equal(np.round(labels.index), np.where(np.arange(40) < 27, 2, 6) * np.ones((12, 1)))
    costs = np.full((10, 10, 9), 255, np.uint8)
    assert label_planes(costs, np.zeros((10, 10), np.float32)).margin.max() == 0.0
    costs[..., 4] = 0
    assert label_planes(costs, np.zeros((10, 10), np.float32)).margin.min() >= 255.0


def test_smoothing_is_that_of_full_matrices_and_stops_at_edges() -> None:
    values = RNG.uniform(0, 2, (13, 17, 2)).astype(np.float32)
    guide = (RNG.integers(0, 256, (13, 17, 3)) / 255).astype(np.float32)
    guide[0, 0] = 1.0
    np.testing.assert_allclose(smooth(values, guide, 50.0, 0.3), smooth_plainly(values, guide, 50.0, 0.3), atol=1e-5)
    # The graph Laplacian has columns that sum to 0, so sums stay; an edge of 20 contrasts lets exp(-20) through.
    values = RNG.uniform(0, 1, (24, 30, 1)).astype(np.float32)
    guide = np.where(np.arange(30) < 15, 0.0, 1.0).astype(np.float32)[None, :, None] * np.ones((24, 1, 1), np.float32)
    result = smooth(values, guide, 400.0, 0.05)
    for side in (np.s_[:, :15], np.s_[:, 15:]):
        assert result[side].mean() == pytest.approx(values[side].mean(), abs=1e-4)
        assert result[side].std() < 0.2 * values[side].std()
    guide = np.where(np.arange(40) < 20, 0.0, 1.0).astype(np.float32)[None, :, None] * np.ones((20, 1, 1), np.float32)
    weights = np.zeros((20, 40), np.float32)
    weights[:, 2], weights[:, 37] = 1.0, 1.0
    values = np.where(np.arange(40) < 20, 1.0, 2.0).astype(np.float32) * np.ones((20, 1), np.float32)
    filled = interpolate(np.where(weights > 0, values, 9.0).astype(np.float32), weights, guide, 400.0, 0.05)
    np.testing.assert_allclose(filled, values, atol=1e-3)


def smooth_plainly(values: np.ndarray, guide: np.ndarray, smoothness: float, contrast: float) -> np.ndarray:
    """Weighted least squares by full matrices, line by line, in three rounds (Min et al. 2014, Algorithm 2)."""
    result = values.astype(np.float64)
    across, down = (np.exp(-np.linalg.norm(np.diff(guide, axis=axis), axis=-1) / contrast) for axis in (1, 0))
    for strength in (1.5 * 4.0 ** (3 - t) / (4.0**3 - 1.0) * smoothness for t in (1, 2, 3)):
        for y in range(result.shape[0]):
            result[y] = np.linalg.solve(line_matrix(across[y], strength), result[y])
        for x in range(result.shape[1]):
            result[:, x] = np.linalg.solve(line_matrix(down[:, x], strength), result[:, x])
    return result


def line_matrix(links: np.ndarray, strength: float) -> np.ndarray:
    """Identity plus strength times the graph Laplacian of a line."""
    differences = np.diff(np.eye(len(links) + 1), axis=0)
    return np.eye(len(links) + 1) + strength * differences.T @ (links[:, None] * differences)


def test_weighted_medians_are_those_of_the_open_loops_and_mend_a_fattened_edge() -> None:
    values, weights = (RNG.uniform(0.1, 2, (14, 15)).astype(np.float32) for _ in range(2))
    guide, where = RNG.uniform(0, 0.3, (14, 15, 3)).astype(np.float32), RNG.uniform(0, 1, (14, 15)) > 0.4
    fast = weighted_medians(values, weights, guide, where, 3, 0.1)
    np.testing.assert_array_equal(fast, weighted_medians_reference(values, weights, guide, where, 3, 0.1))
    guide = np.where(np.arange(40) < 20, 0.1, 0.6).astype(np.float32)[None, :, None] * np.ones((20, 1, 3), np.float32)
    fat = np.where(np.arange(40) < 23, 1.5, 0.7).astype(np.float32) * np.ones((20, 1), np.float32)
    moved = weighted_medians(fat, np.ones_like(fat), guide, near_steps(fat, 5, 0.05), 6, 0.07)
    np.testing.assert_array_equal(moved, np.where(np.arange(40) < 20, 1.5, 0.7).astype(np.float32) * np.ones((20, 1), np.float32))


def test_levels_bound_memory_and_points_the_range() -> None:
    assert level_sizes(960, 640, 100, 1 << 27) == [(960, 640)]
    sizes = level_sizes(6000, 4000, 112, 1 << 27)
    assert sizes[-1] == (6000, 4000)
    assert sizes[0][0] * sizes[0][1] * 112 <= 1 << 27
    assert all(abs(width / height - 1.5) < 0.01 for width, height in sizes)
    assert halvings(0.4, 0.1) == [0.2, 0.1] and halvings(0.1, 0.3) == [0.05]
    assert all(finer[0] <= 2.01 * coarser[0] for coarser, finer in pairwise(sizes))
    depths = 1.0 / np.linspace(0.5, 1.5, 201)
    farthest, nearest = SparseDepths(np.zeros((201, 2)), depths).dioptre_range(0.1)
    assert (farthest, nearest) == pytest.approx((0.51 - 0.098, 1.49 + 0.098))


def test_other_views_support_hide_or_contradict_and_change_trust() -> None:
    """A card at 0.8 m before a wall at 1.6 m: a wall that the reference sees in place of the card is contradicted by nobody (the
    neighbour has the card in the way), a card in place of the wall by all who see the wall."""
    scene = traced((wall(1.6), card(0.8, -0.08, 0.1)))
    others = [ViewDepth(v, (1 / d).astype(np.float32), np.ones_like(d)) for v, d in zip(scene.views[1:], scene.depth_m[1:], strict=True)]
    true = consistency(scene.views[0], scene.dioptre, others, 0.02)
    on_card, inner = scene.depth_m[0] < 1.0, np.s_[10:-10, 20:-20]
    # Pixels beside an edge read the other surface in one view or another: 2 of the 40 columns or so on each side.
    assert np.mean(true.supports[inner] >= 2) > 0.97
    assert np.mean(true.contradictions[inner] > 0) < 0.03
    behind = consistency(scene.views[0], np.full_like(scene.dioptre, 1 / 1.6), others, 0.02)
    middle_of_card = on_card & np.roll(on_card, 14, axis=1) & np.roll(on_card, -14, axis=1)
    assert middle_of_card.any() and not behind.contradictions[middle_of_card].any()
    before = consistency(scene.views[0], np.full_like(scene.dioptre, 1 / 0.8), others, 0.02)
    far_from_card = np.s_[20:-20, 30:40]
    assert np.median(before.contradictions[far_from_card]) >= 3
    trust = np.full((1, 3), 0.4, np.float32)
    seen = Consistency(np.array([[2, 0, 0]]), np.array([[0, 0, 3]]))
    np.testing.assert_allclose(with_consistency(trust, seen), [[0.7, 0.4, 0.08]], atol=1e-6)
    scores, margins = np.array([[0.95, 0.95, 0.1]], np.float32), np.array([[200.0, 2.0, 200.0]], np.float32)
    sure, unclear, unlike = sweep_trust(scores, margins)[0]
    assert sure > 0.85 and unclear < 0.15 and unlike == 0.0


def test_a_desk_comes_out_in_metres_and_confidence_tells_right_from_wrong() -> None:
    """0.1 px of parallax in the widest neighbour (170 px * 0.06 m) is 0.0098 dioptre. The plain card is off in part."""
    scene, found = desk(), desk_depth()
    grey = np.abs(scene.rgb[0] - [0.2, 0.25, 0.5]).max(axis=2) < 0.06
    assert np.median(np.abs(1.0 / found.depth_m - scene.dioptre)) < 0.0098
    assert wrong(found, scene)[~grey].mean() < 0.05
    assert np.isfinite(found.depth_m).all() and found.depth_m.min() > 0
    assert found.confidence.min() >= 0.0 and found.confidence.max() <= 1.0
    on_edge = near_steps(scene.dioptre, 1, 0.05)  # where a pixel holds two depths, neither is wrong
    off, sure, unsure = wrong(found, scene), (found.confidence > 0.5) & ~on_edge, (found.confidence < 0.2) & ~on_edge
    assert off[sure].mean() < 0.01
    assert off[unsure].mean() > 10 * off[sure].mean()
    assert (found.confidence > 0.5).mean() > 0.6
    np.testing.assert_array_equal(found.source == FILLED, found.confidence < 0.15)
    assert set(np.unique(found.source)) <= {SWEEP, FILLED}


def test_memory_can_be_bounded_by_coarser_levels() -> None:
    """Half the size at first: edges of the coarse level are twice as wide, surfaces as exact."""
    scene = desk()
    cells = WIDTH_PX * HEIGHT_PX * 28 // 4  # 28 planes: 1.3 dioptres * 10.6 px over 0.5 px
    found = dense_depth(scene.rgb[0], scene.views[0], scene.views[1:], RANGE, settings=DenseSettings(most_cells=cells))
    assert np.median(np.abs(1.0 / found.depth_m - scene.dioptre)) < 0.0098
    assert wrong(found, scene).mean() < 2.5 * wrong(desk_depth(), scene).mean() + 0.05


def test_sparse_points_settle_what_has_no_texture() -> None:
    """An even wall with five known points: nothing else says where it is."""
    scene = traced((grey_card(1.0, -0.7, 0.7), wall(1.0, tilt=0.0)))
    flat = np.full_like(scene.rgb[0], 0.4)
    blank = [SweepView(np.full_like(each.structure, 0.6), each.camera) for each in scene.views]
    xy_px = np.array([[20.5, 20.5], [140.5, 30.5], [80.5, 60.5], [30.5, 90.5], [130.5, 100.5]])
    found = dense_depth(flat, blank[0], blank[1:], RANGE, DepthPriors(sparse=SparseDepths(xy_px, np.full(5, 1.25))))
    np.testing.assert_allclose(found.depth_m, 1.25, rtol=0.03)
    assert found.confidence.max() < 0.2, "a guess from five points is no measurement"


def test_focus_finds_what_no_neighbour_sees() -> None:
    """Neighbours that look elsewhere: only focus knows; its depth is taken and named as the source."""
    scene = traced((wall(1.25),))
    elsewhere = [SweepView(RNG.uniform(0, 1, each.structure.shape).astype(np.float32), each.camera) for each in scene.views[1:]]
    ones = np.ones_like(scene.dioptre)
    vote = FocusVote(0.8 * ones, ones, 2.0 * ones, 0.1)
    found = dense_depth(scene.rgb[0], scene.views[0], elsewhere, RANGE, DepthPriors(focus=vote))
    assert np.median(np.abs(1.0 / found.depth_m - 0.8)) < 0.02
    assert np.mean(found.source == FOCUS) > 0.8
    assert 0.1 < np.median(found.confidence) <= 0.6


def test_patch_match_is_seen_at_the_pixels_of_the_real_picture() -> None:
    """A ramp over the undistorted ray: the real picture must have it at its own, undistorted rays."""
    camera, k1 = Camera(WIDTH_PX, HEIGHT_PX, (FOCAL_PX, FOCAL_PX), (80.0, 56.0)), 0.1
    undistorted = Camera(200, 140, (FOCAL_PX, FOCAL_PX), (100.0, 70.0))
    ramp = np.broadcast_to(1.0 + 0.01 * np.arange(200, dtype=np.float32), (140, 200)).copy()
    ramp[:, :40] = 0.0
    depth = on_original_pixels(ramp, undistorted, camera, (k1, 0.0))
    u = 30.0 / FOCAL_PX
    distorted_x = 80.0 + FOCAL_PX * u * (1 + k1 * u * u)  # of the point at 130 px in the undistorted picture
    assert depth[56, int(distorted_x)] == pytest.approx(1.0 + 0.01 * 129.5, abs=0.011)
    assert np.isnan(depth[56, 5])
    prior = patch_match_prior(depth)
    assert len(prior.depth_m) == np.isfinite(depth).sum()
    obstacle = patch_match_obstacle()
    assert obstacle is None or "pycolmap" in obstacle or "GPU" in obstacle


def test_a_range_that_reaches_infinity_gives_depths_before_it() -> None:
    scene = traced((wall(4.0),))
    found = dense_depth(scene.rgb[0], scene.views[0], scene.views[1:], (0.0, 0.6))
    assert np.isfinite(found.depth_m).all() and found.depth_m.min() > 0
    assert np.median(1.0 / found.depth_m) == pytest.approx(1 / 4, abs=0.0098)


SLICE_DIOPTRES = np.linspace(1.6, 0.5, 12)
PLANES = np.linspace(0.4, 1.7, 53)
SHAPE = (6, 8)


def vote_for(index: float) -> FocusVote:
    """Focus found one depth everywhere and trusts it, except in the first row."""
    confidence = np.ones(SHAPE, np.float32)
    confidence[0] = 0.0
    return focus_vote_of_map(np.full(SHAPE, index, np.float32), confidence, SLICE_DIOPTRES)


def test_lights_reach_as_far_as_half_the_largest_blur() -> None:
    rgb = np.full((41, 41, 3), 0.2, np.float32)
    rgb[20, 20, 0] = 3.0
    row = near_highlights(rgb, 12.0)[20]
    assert row[20 - 6 : 20 + 7].all()
    assert not row[: 20 - 8].any() and not row[20 + 9 :].any()


def test_focus_decides_where_views_do_not_and_costs_keep_their_range() -> None:
    vote = vote_for(6.0)  # 1.0 dioptre
    costs = np.full((*SHAPE, len(PLANES)), 255, np.uint8)
    sure = np.abs(PLANES - 0.7).argmin()
    costs[2, 2] = np.minimum(255, 40 * np.abs(np.arange(len(PLANES)) - sure))
    add_focus_votes(costs, PLANES, vote)
    best = PLANES[costs.argmin(axis=-1)]
    assert abs(best[4, 4] - 1.0) < 0.026 and abs(best[2, 2] - 0.7) < 0.026
    assert np.ptp(costs[0]) == 0, "an untrusted pixel stays undecided"
    # Full cost of both is full cost of the sum: shares add up to 1.
    vote = FocusVote(np.full(SHAPE, 1.0, np.float32), np.ones(SHAPE, np.float32), np.full(SHAPE, 2.0, np.float32), 0.1)
    costs = np.full((*SHAPE, len(PLANES)), 255, np.uint8)
    add_focus_votes(costs, PLANES, vote)
    far = np.abs(PLANES - 1.0) > 0.3
    assert (costs[..., far] == 255).all()
    assert costs.min() == pytest.approx(255 * (1 - SHARE_OF_FOCUS), abs=1)


def test_votes_of_focus_hold_for_what_it_found_and_keep_depths_when_smaller() -> None:
    vote = dataclasses.replace(vote_for(6.0), curvature=np.full(SHAPE, 2.0, np.float32))
    here, half_a_step, far = (agreement(vote, np.full(SHAPE, d, np.float32))[3, 3] for d in (1.0, 0.95, 0.7))
    assert here > half_a_step > far
    assert far < 1e-3
    index = np.array([[0.2, 4.5, 10.9]], np.float32)
    vote = focus_vote_of_map(index, np.full((1, 3), 0.8, np.float32), SLICE_DIOPTRES)
    np.testing.assert_allclose(vote.trust, [[0.0, 0.8, 0.0]])
    assert vote.dioptre[0, 1] == pytest.approx(1.15)
    # Averaging would invent a depth between two surfaces.
    dioptre = np.where(np.arange(8) < 4, 0.5, 1.5).astype(np.float32) * np.ones((6, 1), np.float32)
    vote = FocusVote(dioptre, np.ones(SHAPE, np.float32), np.ones(SHAPE, np.float32), 0.1)
    small = vote.resized(4, 3)
    assert small.dioptre.shape == small.trust.shape == small.curvature.shape == (3, 4)
    np.testing.assert_array_equal(small.dioptre, [[0.5, 0.5, 1.5, 1.5]] * 3)
    assert vote.resized(8, 6) is vote
