"""What the measures of fused pictures must say of pictures whose fusion is known."""

from functools import lru_cache

import cv2
import numpy as np
import pytest

from tests.bench.fusion_measures import (
    FEATURE,
    MEASURES,
    ORIENTATION,
    STRENGTH,
    FusionScores,
    Picture,
    correlation_entropy,
    fusion_scores,
    phase_congruency,
)

SIDE_PX = 160


@lru_cache(maxsize=1)
def textured() -> np.ndarray:
    """Grey noise of several sizes, 0 to 255 in even shares, so that its entropy is the largest there is."""
    rng = np.random.default_rng(1)
    noise = np.sum([size * cv2.GaussianBlur(rng.normal(size=(SIDE_PX, SIDE_PX)), (0, 0), size) for size in (0.7, 1.5, 4.0)], axis=0)
    ranks = noise.ravel().argsort().argsort().reshape(noise.shape)
    return np.floor(256.0 * ranks / ranks.size)


@lru_cache(maxsize=1)
def pair() -> tuple[Picture, Picture, Picture]:
    """(sharp on the left, sharp on the right, sharp everywhere)."""
    sharp = textured()
    blurred = cv2.GaussianBlur(sharp, (0, 0), 3.0)
    left = np.arange(SIDE_PX) < SIDE_PX // 2
    return Picture(np.where(left, sharp, blurred)), Picture(np.where(left, blurred, sharp)), Picture(sharp)


def test_a_picture_fused_with_itself_keeps_all() -> None:
    same = Picture(textured())
    # The largest values of the two sigmoids of Q_AB/F, at ratios of 1.
    largest = np.prod([most / (1.0 + np.exp(slope * (1.0 - middle))) for most, slope, middle in (STRENGTH, ORIENTATION)])
    # Q_NCIE is 1 where three pictures of even shares of codes are the same: one eigenvalue is 3, the others 0.
    found = fusion_scores(same, same, same)
    np.testing.assert_allclose([found.gradients, found.entropy, found.contrast], [largest, 1.0, 1.0], atol=2e-3)
    # Q_P compares the features of the sources with all of the fused picture, also with what is too faint to be a feature.
    assert 0.9 < found.phase < 1.0


def test_pictures_that_have_nothing_in_common_have_the_least_correlation_entropy() -> None:
    # Three equal eigenvalues: 1 - log_256(3). What is left comes from counting 65536 pairs of codes in as many pixels.
    rng = np.random.default_rng(2)
    apart = [Picture(rng.permutation(np.arange(512 * 512) % 256).reshape(512, 512).astype(np.float64)) for _ in range(3)]
    assert correlation_entropy(*apart) == pytest.approx(1.0 - np.log(3.0) / np.log(256.0), abs=1e-3)


@pytest.mark.parametrize("measure", range(len(MEASURES)), ids=MEASURES)
def test_the_true_fusion_is_better_than_a_blurred_one(measure: int) -> None:
    a, b, sharp = pair()
    blurred = Picture(cv2.GaussianBlur(sharp.grey, (0, 0), 3.0))
    assert fusion_scores(a, b, sharp)[measure] > fusion_scores(a, b, blurred)[measure]


@pytest.mark.parametrize("measure", [0, 1, 3], ids=[MEASURES[index] for index in (0, 1, 3)])
def test_the_true_fusion_is_better_than_the_mean(measure: int) -> None:
    """Not by Q_P, which does not see that contrast is halved: phase congruency does not depend on it."""
    a, b, sharp = pair()
    assert fusion_scores(a, b, sharp)[measure] > fusion_scores(a, b, Picture((a.grey + b.grey) / 2.0))[measure]


def test_the_order_of_the_sources_does_not_matter() -> None:
    a, b, sharp = pair()
    np.testing.assert_allclose(fusion_scores(a, b, sharp), fusion_scores(b, a, sharp), rtol=1e-6)


def test_contrast_kept_does_not_depend_on_the_range_of_the_picture() -> None:
    """Q_CB stretches each picture to 0 to 255 first; the other measures see that a picture is darker."""
    a, b, sharp = pair()
    darker = Picture(sharp.grey / 5.0)  # 255 / 5 is whole, so that stretching gives the same codes
    before, after = (fusion_scores(a, b, each) for each in (sharp, darker))
    assert after.contrast == pytest.approx(before.contrast, abs=1e-6)
    assert after.gradients < 0.8 * before.gradients


def test_phase_congruency_marks_a_step_where_it_is_and_as_much_at_half_the_contrast() -> None:
    rng = np.random.default_rng(3)
    step = np.where(np.arange(SIDE_PX) < SIDE_PX // 2, 60.0, 180.0) + rng.normal(0.0, 0.5, (SIDE_PX, SIDE_PX))
    found, fainter = phase_congruency(step), phase_congruency(step / 2.0)
    middle = slice(SIDE_PX // 4, 3 * SIDE_PX // 4)
    columns = found.congruency[middle].mean(axis=0)[20:-20]  # the Fourier transform has a step at the frame as well
    assert abs(int(columns.argmax()) + 20 - SIDE_PX // 2) <= 1
    edge = (middle, slice(SIDE_PX // 2 - 1, SIDE_PX // 2 + 1))
    np.testing.assert_allclose(fainter.congruency[edge].mean(), found.congruency[edge].mean(), rtol=0.01)
    # Away from it there is noise, which is taken off: no feature by the threshold of Q_P.
    assert found.congruency[edge].mean() > 3.0 * FEATURE and np.median(columns[:20]) < FEATURE


def test_luma_is_that_of_rec_601() -> None:
    rgb = np.zeros((1, 4, 3), np.uint8)
    rgb[0, 0, 0] = rgb[0, 1, 1] = rgb[0, 2, 2] = 255
    rgb[0, 3] = 255
    # 0.2989, 0.5870 and 0.1140 of 255, rounded.
    np.testing.assert_array_equal(Picture.of(rgb).grey[0], [76.0, 150.0, 29.0, 255.0])


def test_scores_have_a_name_each() -> None:
    assert len(MEASURES) == len(FusionScores._fields)
