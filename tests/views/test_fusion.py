"""Where focus votes on depth, and how it is blended with the views."""

import dataclasses

import numpy as np
import pytest

from capture.dense.depth_priors import (
    SHARE_OF_FOCUS,
    FocusVote,
    add_focus_votes,
    agreement,
    focus_vote_of_map,
    near_highlights,
)

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


def test_focus_decides_where_views_do_not_and_yields_where_they_do() -> None:
    vote = vote_for(6.0)  # 1.0 dioptre
    costs = np.full((*SHAPE, len(PLANES)), 255, np.uint8)
    sure = np.abs(PLANES - 0.7).argmin()
    costs[2, 2] = np.minimum(255, 40 * np.abs(np.arange(len(PLANES)) - sure))
    add_focus_votes(costs, PLANES, vote)
    best = PLANES[costs.argmin(axis=-1)]
    assert abs(best[4, 4] - 1.0) < 0.026 and abs(best[2, 2] - 0.7) < 0.026
    assert np.ptp(costs[0]) == 0, "an untrusted pixel stays undecided"


def test_blended_costs_keep_their_range() -> None:
    """Full cost of both is full cost of the sum: shares add up to 1."""
    vote = FocusVote(np.full(SHAPE, 1.0, np.float32), np.ones(SHAPE, np.float32), np.full(SHAPE, 2.0, np.float32), 0.1)
    costs = np.full((*SHAPE, len(PLANES)), 255, np.uint8)
    add_focus_votes(costs, PLANES, vote)
    far = np.abs(PLANES - 1.0) > 0.3
    assert (costs[..., far] == 255).all()
    assert costs.min() == pytest.approx(255 * (1 - SHARE_OF_FOCUS), abs=1)


def test_focus_vouches_only_for_what_it_found() -> None:
    vote = dataclasses.replace(vote_for(6.0), curvature=np.full(SHAPE, 2.0, np.float32))
    here, half_a_step, far = (agreement(vote, np.full(SHAPE, d, np.float32))[3, 3] for d in (1.0, 0.95, 0.7))
    assert here > half_a_step > far
    assert far < 1e-3


def test_a_finished_focus_map_votes_with_its_confidence() -> None:
    index = np.array([[0.2, 4.5, 10.9]], np.float32)
    vote = focus_vote_of_map(index, np.full((1, 3), 0.8, np.float32), SLICE_DIOPTRES)
    np.testing.assert_allclose(vote.trust, [[0.0, 0.8, 0.0]])
    assert vote.dioptre[0, 1] == pytest.approx(1.15)


def test_a_smaller_vote_keeps_depths_of_single_pixels() -> None:
    """Averaging would invent a depth between two surfaces."""
    dioptre = np.where(np.arange(8) < 4, 0.5, 1.5).astype(np.float32) * np.ones((6, 1), np.float32)
    vote = FocusVote(dioptre, np.ones(SHAPE, np.float32), np.ones(SHAPE, np.float32), 0.1)
    small = vote.resized(4, 3)
    assert small.dioptre.shape == small.trust.shape == small.curvature.shape == (3, 4)
    np.testing.assert_array_equal(small.dioptre, [[0.5, 0.5, 1.5, 1.5]] * 3)
    assert vote.resized(8, 6) is vote
