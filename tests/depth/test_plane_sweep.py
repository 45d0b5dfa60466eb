"""Plane sweep: the compiled loops say what the open ones say, and traced scenes come out where they are."""

from dataclasses import replace
from functools import cache

import cv2
import numpy as np
import pytest

from mrbokeh.depth.views.plane_sweep import (
    UNSEEN,
    WORST_COST,
    Matching,
    PlaneScores,
    by_parallax,
    dioptre_planes,
    pixels_per_dioptre,
    plane_sweep,
    refine,
)
from mrbokeh.depth.views.sweep_view import BRIGHTEST, SweepView, structure_of
from mrbokeh.optics.camera import Camera
from tests.support.dense_references import scores_of_surface
from tests.support.plane_sweep_scenes import FOCAL_PX, card, traced, wall
from tests.support.refusals import refused

INNER = np.s_[8:-8, 12:-12]


tilted_wall = cache(lambda: traced((wall(1.0, tilt=0.6),)))


def turned_view(seed: int, distortion: tuple[float, float], turn_rad: float, size: tuple[int, int] = (28, 36)) -> SweepView:
    """A patchy picture by a camera with unequal focal lengths, turned and moved."""
    rng = np.random.default_rng(seed)
    structure = cv2.GaussianBlur(rng.uniform(0, 1, size).astype(np.float32), (0, 0), 1.0)
    pose = np.eye(4)
    pose[:3, :3] = cv2.Rodrigues(turn_rad * rng.normal(size=3))[0]
    pose[:3, 3] = 0.1 * rng.normal(size=3)
    return SweepView(structure, Camera(size[1], size[0], (40.0, 41.0), (18.3, 13.6), pose), distortion)


def test_compiled_scores_are_those_of_the_open_loops_in_bands_of_rows_as_well() -> None:
    """Turned, distorted cameras of two sizes around an uneven surface; part of it is outside of every neighbour."""
    reference = turned_view(0, (0.05, -0.02), 0.1)
    neighbours = [turned_view(1, (0.03, 0.01), 0.1), turned_view(2, (0.0, 0.0), 0.2), turned_view(3, (-0.1, 0.0), 0.1, (24, 30))]
    surface = cv2.GaussianBlur(np.random.default_rng(4).uniform(0.4, 2.0, (28, 36)).astype(np.float32), (0, 0), 3.0)
    matching = Matching(radius_px=2, best=2, noise=0.01)
    offset = 0.13
    plain = scores_of_surface(reference, neighbours, (surface + offset).astype(np.float64), matching)
    fast = PlaneScores(reference, neighbours, matching, surface).of_rows(0, 28, offset)
    seen = fast > UNSEEN
    assert 0.5 < seen.mean() < 1.0, "the test needs pixels that nobody sees"
    np.testing.assert_array_equal(seen, np.isfinite(plain))
    np.testing.assert_allclose(fast[seen], plain[seen], atol=2e-4)
    reference, neighbours = turned_view(0, (0.0, 0.0), 0.1), [turned_view(1, (0.0, 0.0), 0.1)]
    sweep = PlaneScores(reference, neighbours, Matching(radius_px=3), np.ones((28, 36), np.float32))
    whole = sweep.of_rows(0, 28, 0.0)
    pieces = np.concatenate([sweep.of_rows(first, min(first + 5, 28), 0.0) for first in range(0, 28, 5)])
    np.testing.assert_allclose(pieces, whole, atol=1e-6)


@pytest.mark.slow
def test_planes_step_by_so_many_pixels_in_the_widest_neighbour() -> None:
    """Sideways motion b shifts a point by f b pixels per dioptre: 170 px * 0.06 m = 10.2 px."""
    scene = tilted_wall()
    assert pixels_per_dioptre(scene.views[0], scene.views[1], 2.0, 0.4) == pytest.approx(FOCAL_PX * 0.06)
    planes = dioptre_planes(scene.views[0], scene.views[1:2], (0.4, 2.0), 0.5)
    assert np.diff(planes).max() * FOCAL_PX * 0.06 <= 0.5 + 1e-9
    assert (planes[0], planes[-1]) == (0.4, 2.0)
    assert len(dioptre_planes(scene.views[0], scene.views[1:], (0.4, 2.0), 0.5, most=9)) == 9


def test_neighbours_of_little_parallax_come_first_and_those_of_none_are_refused() -> None:
    """Over 1 dioptre a view moved by 0.06 m travels 10.2 px, one by 0.2 m 34 px, one by 0.001 m 0.2 px."""
    view = tilted_wall().views[0]

    def moved(x_m: float) -> SweepView:
        pose = np.eye(4)
        pose[0, 3] = -x_m
        return replace(view, camera=replace(view.camera, camera_from_world=pose))

    others = [moved(0.2), moved(0.001), moved(0.06)]
    assert by_parallax(view, others, (0.5, 1.5)) == [others[2], others[0], others[1]]
    refused("parallax", dioptre_planes, view, [view], (0.4, 2.0))
    refused("neighbouring view", plane_sweep, view, [], np.array([1.0]))


def test_a_wall_is_found_at_its_dioptre_and_cost_is_least_there() -> None:
    scene = traced((wall(1.25),))
    planes = np.linspace(0.5, 1.1, 13)  # plane 6 is at 0.8 = 1 / 1.25
    costs = plane_sweep(scene.views[0], scene.views[1:], planes)
    assert np.mean(costs[INNER].argmin(axis=-1) == 6) > 0.99
    assert np.median(costs[INNER][..., 6]) < 0.1 * WORST_COST < 0.5 * WORST_COST < np.median(costs[INNER][..., 0])


def test_refinement_follows_a_slant_that_planes_cut_in_steps() -> None:
    """A tenth of a pixel of the widest neighbour is 0.0098 dioptre; the planes lie 0.05 dioptre (0.5 px) apart."""
    scene = tilted_wall()
    planes = dioptre_planes(scene.views[0], scene.views[1:], (0.4, 1.9))
    step = float(planes[1] - planes[0])
    coarse = planes[plane_sweep(scene.views[0], scene.views[1:], planes).argmin(axis=-1)].astype(np.float32)
    fine = refine(scene.views[0], scene.views[1:], cv2.medianBlur(coarse, 5), 0.5 * step)
    before, after = (np.median(np.abs(each - scene.dioptre)[INNER]) for each in (coarse, fine.dioptre))
    assert after < 0.4 * before
    assert after * FOCAL_PX * 0.06 < 0.1
    assert np.median(fine.score[INNER]) > 0.9


def test_a_point_hidden_from_half_of_the_views_is_found_by_the_others() -> None:
    """Left of the card a band of 0.06 m * 170 px * (1/0.8 - 1/1.6) = 6 px is hidden from the view on the right."""
    scene = traced((wall(1.6), card(0.8, -0.08, 0.1)))
    left_edge = int(np.argmax(scene.depth_m[0][56] < 1.0))
    planes = np.linspace(0.4, 1.5, 23)
    band = np.s_[20:-20, left_edge - 5 : left_edge - 2]
    errors = {}
    for best in (2, 4):
        found = planes[plane_sweep(scene.views[0], scene.views[1:], planes, Matching(1, best)).argmin(axis=-1)]
        errors[best] = np.mean(np.abs(found - scene.dioptre)[band] > 0.1)
    assert errors[2] < 0.15
    assert errors[4] > 2.0 * errors[2], "the hidden view must spoil the mean of all"


def test_a_distorted_picture_needs_its_distortion() -> None:
    """Pictures bent by k1 = 0.2 as COLMAP's model says match only if the sweep knows."""
    scene, k1 = tilted_wall(), 0.2
    views = [replace(each, structure=_bent(each, k1), distortion=(k1, 0.0)) for each in scene.views[:2]]
    straight = [replace(each, distortion=(0.0, 0.0)) for each in views]
    dioptre = _bent(replace(scene.views[0], structure=scene.dioptre), k1)
    known, ignored = (np.median(refine(a, [b], dioptre, 0.02).score[INNER]) for a, b in (views, straight))
    assert known > 0.9
    assert ignored < known


def _bent(view: SweepView, k1: float) -> np.ndarray:
    """The picture that a lens with k1 takes instead: at a distorted place what the pinhole has at the undistorted one."""
    from mrbokeh.distortion.radial import undistorted_px

    x, y = np.moveaxis(undistorted_px(view.camera, (k1, 0.0), view.camera.pixel_centres_px()) - 0.5, -1, 0).astype(np.float32)
    return cv2.remap(view.structure, x, y, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)


def test_pixels_beyond_the_fold_of_the_distortion_are_seen_by_nobody() -> None:
    """r (1 + k1 r^2) with k1 = -2 never exceeds 0.272 (at r = 0.408): what lies farther out has no ray."""
    view = turned_view(0, (-2.0, 0.0), 0.0)
    camera = view.camera
    radius = np.linalg.norm((camera.pixel_centres_px() - camera.principal_px) / np.asarray(camera.focal_px), axis=-1)
    sweep = PlaneScores(view, [turned_view(1, (0.0, 0.0), 0.0, (60, 80))], Matching(), np.ones((28, 36), np.float32))
    scores = sweep.of_rows(0, 28, 0.0)
    assert (scores[radius > 0.28] == UNSEEN).all()
    assert (scores[radius < 0.15] > UNSEEN).any()


def test_structure_evens_out_shot_noise_and_cuts_lights() -> None:
    """Noise of variance proportional to light: its deviation in the square root is the same at any level (half of the factor)."""
    rng = np.random.default_rng(0)
    light = np.repeat(np.array([0.1, 0.9], np.float32)[:, None, None], 3, axis=2) * np.ones((2, 20000, 3), np.float32)
    noisy = light + 0.01 * np.sqrt(light) * np.repeat(rng.normal(size=(2, 20000, 1)), 3, axis=2)
    np.testing.assert_allclose(structure_of(noisy.astype(np.float32)).std(axis=1), 0.005, rtol=0.05)
    assert structure_of(np.full((1, 1, 3), 50.0, np.float32)).item() == pytest.approx(np.sqrt(BRIGHTEST))
