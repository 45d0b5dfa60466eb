"""The parts of registration, each with a known answer."""

import cv2
import numpy as np
import pytest

from capture.merging.registration.corner_tracks import CornerTracks, similarity_of_tracks, structure_of, track_corners
from capture.merging.registration.pair_matching import joint_transforms, match_coarsely, match_neighbours
from capture.merging.registration.plane_transforms import (
    Transform,
    about_centre,
    chained,
    farthest_corner_px,
    inverse,
    moved,
    scale_of,
    warp,
)
from capture.merging.registration.registration_file import breathing_of

HEIGHT_PX, WIDTH_PX = 300, 400


def scene(seed: int = 0) -> np.ndarray:
    """Detail of many sizes: sums of smoothed noise."""
    rng = np.random.default_rng(seed)
    noises = [rng.uniform(0, 1, (HEIGHT_PX, WIDTH_PX, 3)).astype(np.float32) for _ in range(3)]
    summed = sum(cv2.GaussianBlur(noise, (0, 0), sigma) * sigma for noise, sigma in zip(noises, (1.5, 4, 10), strict=True))
    return np.clip(0.35 + 1.2 * (summed - np.mean(summed)), 0.01, None).astype(np.float32)


def similarity(scale: float, angle_rad: float, shift_px: tuple[float, float]) -> Transform:
    turn = scale * np.array([[np.cos(angle_rad), -np.sin(angle_rad)], [np.sin(angle_rad), np.cos(angle_rad)]])
    centre = np.array([WIDTH_PX / 2, HEIGHT_PX / 2])
    return np.column_stack([turn, centre - turn @ centre + shift_px])


def corner_error_px(a: Transform, b: Transform) -> float:
    return farthest_corner_px(a, b, WIDTH_PX, HEIGHT_PX)


MOVEMENTS = [
    similarity(1.0, 0.0, (0.0, 0.0)),
    similarity(1.0, 0.0, (7.3, -4.6)),
    similarity(0.93, 0.0, (0.0, 12.0)),
    similarity(1.03, np.deg2rad(0.4), (1.2, -0.8)),
]


@pytest.mark.parametrize("truth", MOVEMENTS)
def test_a_known_movement_is_found_through_different_blur(truth: Transform) -> None:
    """The slice is blurred by another disc than the target, as two slices of a focal stack are."""
    target, source = structure_of(scene()), structure_of(cv2.GaussianBlur(warp(scene(), inverse(truth)), (0, 0), 2.0))
    coarse = match_coarsely(target, source, np.eye(2, 3))
    assert coarse.correlation > 0.9 and corner_error_px(coarse.target_from_source, truth) < 1.0
    assert corner_error_px(match_neighbours(target, source).target_from_source, truth) < 0.15


def test_unrelated_pictures_do_not_match() -> None:
    match = match_neighbours(structure_of(scene(1)), structure_of(scene(2)), expected_scale=1.02)
    assert match.tracks is None and not match.guess_holds
    np.testing.assert_allclose(match.target_from_source, about_centre(1.02, WIDTH_PX, HEIGHT_PX), atol=1e-9)


def test_tracks_lead_where_the_slice_went() -> None:
    truth = similarity(1.01, 0.0, (0.7, -1.3))
    target, source = structure_of(scene()).levels[-1], structure_of(warp(scene(), inverse(truth))).levels[-1]
    tracks = track_corners(target, source, np.eye(2, 3))
    assert len(tracks) > 100
    off_px = np.hypot(*(tracks.target_px - moved(truth, tracks.source_px)).T)
    assert np.median(off_px) < 0.1


def test_corners_keep_away_from_what_is_not_valid() -> None:
    valid = np.ones((HEIGHT_PX, WIDTH_PX), bool)
    valid[100:140, 150:250] = False
    levels = structure_of(scene(), valid).levels
    for level in levels:
        x, y = (level.corners_px * 2**level.level).T
        assert len(x) > 50
        # A mask of a saturated light reaches 4 px farther, at every size of the picture.
        assert not np.any((x > 147) & (x < 253) & (y > 97) & (y < 143))


def test_masked_ecc_follows_what_is_valid() -> None:
    """Two thirds of the picture move otherwise; the masks of target and source leave the rest."""
    truth, other = similarity(1.0, 0.0, (3.0, 2.0)), similarity(1.0, 0.0, (-3.0, -4.0))
    source = warp(scene(), inverse(truth))
    source[:, 130:] = warp(scene(), inverse(other))[:, 130:]
    valid = np.zeros((HEIGHT_PX, WIDTH_PX), bool)
    valid[:, :120] = True
    masked = match_coarsely(structure_of(scene(), valid), structure_of(source, valid), np.eye(2, 3))
    assert corner_error_px(masked.target_from_source, truth) < 1.0
    unmasked = match_coarsely(structure_of(scene()), structure_of(source), np.eye(2, 3))
    assert corner_error_px(unmasked.target_from_source, truth) > 3.0


def points_px(count: int, seed: int) -> np.ndarray:
    return np.random.default_rng(seed).uniform((0, 0), (WIDTH_PX, HEIGHT_PX), (count, 2))


def test_a_fit_to_exact_tracks_is_exact_and_outliers_do_not_bend_it() -> None:
    truth, source = similarity(0.97, 0.02, (3.0, -5.0)), points_px(200, 0)
    target = moved(truth, source)
    np.testing.assert_allclose(similarity_of_tracks(CornerTracks(target, source)), truth, atol=1e-9)
    target[:60] += np.random.default_rng(1).uniform(2.0, 30.0, (60, 2))
    assert corner_error_px(similarity_of_tracks(CornerTracks(target, source)), truth) < 0.02


def joint_pairs(truth: list[Transform], noise_px: float) -> dict[tuple[int, int], CornerTracks]:
    """Tracks between neighbours and slices two apart: (target, source), as a scene in slice 0 would give them."""
    pairs = {}
    for i, j in [(i, i + stride) for stride in (1, 2) for i in range(len(truth) - stride)]:
        rng = np.random.default_rng([i, j])
        place = points_px(150, i + 10 * j)
        in_i, in_j = (moved(inverse(truth[k]), place) + noise_px * rng.standard_normal((150, 2)) for k in (i, j))
        pairs[i, j] = CornerTracks(in_i, in_j, max(1.5 * noise_px, 0.05))
    return pairs


def test_joint_transforms_of_exact_tracks_are_exact() -> None:
    truth = [similarity(1.0 + 0.01 * i, 0.001 * i, (0.3 * i, -0.5 * i)) for i in range(6)]
    truth = [chained(inverse(truth[0]), each) for each in truth]
    found = joint_transforms(6, joint_pairs(truth, 0.0), (WIDTH_PX, HEIGHT_PX))
    assert max(corner_error_px(a, b) for a, b in zip(found, truth, strict=True)) < 1e-6


def test_joint_homographies_of_exact_tracks_are_exact() -> None:
    truth = [np.vstack([similarity(1.0 + 0.01 * i, 0.001 * i, (0.3 * i, -0.5 * i)), [3e-5 * i, -2e-5 * i, 1.0]]) for i in range(6)]
    truth = [chained(inverse(truth[0]), each) for each in truth]
    found = joint_transforms(6, joint_pairs(truth, 0.0), (WIDTH_PX, HEIGHT_PX), perspective=True)
    assert max(corner_error_px(a, b) for a, b in zip(found, truth, strict=True)) < 1e-6


def test_all_pairs_together_drift_less_than_a_chain_and_outvote_a_wrong_one() -> None:
    truth = [similarity(1.0, 0.0, (0.2 * i, 0.0)) for i in range(10)]
    pairs = joint_pairs(truth, 0.3)
    chain = {pair: tracks for pair, tracks in pairs.items() if pair[1] == pair[0] + 1}

    def worst_px(used: dict[tuple[int, int], CornerTracks]) -> float:
        found = joint_transforms(10, used, (WIDTH_PX, HEIGHT_PX))
        return max(corner_error_px(a, b) for a, b in zip(found, truth, strict=True))

    assert worst_px(pairs) < worst_px(chain)
    wrong = pairs[4, 5]
    pairs[4, 5] = CornerTracks(wrong.target_px + np.array([6.0, 4.0]), wrong.source_px, wrong.scatter_px)
    assert worst_px(pairs) < 0.4


def test_breathing_is_the_lens_where_most_pairs_agree() -> None:
    lens = (40.0, 39.5, 39.0, 38.6)
    measured = {(0, 1): 40.0 / 39.5, (1, 2): 39.5 / 39.0 * 1.002, (2, 3): 39.0 / 38.6 * 1.05}
    breathing = breathing_of(4, measured, lens)
    assert breathing.source == "lens" and breathing.scale(0, 3) == pytest.approx(40.0 / 38.6)
    assert [breathing.allows(pair, scale) for pair, scale in measured.items()] == [True, True, False]


@pytest.mark.parametrize("lens", [None, (40.0, 39.5, 39.0, 38.6, 38.3, 38.0, 37.8)])
def test_breathing_is_fitted_where_the_lens_does_not_tell(lens: tuple[float, ...] | None) -> None:
    """log scale goes with the focus and its square; one pair is wrong by 8 %."""
    along = np.linspace(0, 1, 7) if lens is None else (np.log(lens) - np.log(40.0)) / (np.log(37.8) - np.log(40.0))
    truth = np.exp(0.12 * along + 0.05 * along**2)
    measured = {(i, j): truth[i] / truth[j] for i in range(7) for j in (i + 1, i + 3) if j < 7}
    measured[2, 3] *= 1.08
    breathing = breathing_of(7, measured, lens)
    assert breathing.source == "pictures"
    np.testing.assert_allclose(np.array(breathing.scales) / breathing.scales[0], truth / truth[0], rtol=1e-3)
    assert not breathing.allows((2, 3), measured[2, 3]) and breathing.allows((3, 4), measured[3, 4])


def test_breathing_of_nothing_measured() -> None:
    assert breathing_of(3, {}, None).scales == (1.0, 1.0, 1.0)
    assert breathing_of(3, {}, (36.0, 35.0, 34.0)).scale(0, 2) == pytest.approx(36.0 / 34.0)


def test_scale_of_a_turned_similarity() -> None:
    assert scale_of(similarity(1.07, 0.3, (5, 5))) == pytest.approx(1.07)
