"""Depth of pictures with known cameras: traced scenes, whose depth is exact."""

from dataclasses import replace

import numpy as np
import pytest

from mrbokeh.depth.views._views_numba import carry
from mrbokeh.depth.views.depth_priors import ViewDepth
from mrbokeh.depth.views.still_scene import PosedPicture, StillScene, apart_in_widths, fused, vouched
from mrbokeh.depth.views.sweep_view import SweepView, neighbour_from_reference, packed_view, rays_of
from mrbokeh.depth.views.view_points import best_neighbours, common_points, dioptre_range
from mrbokeh.distortion import LensDistortion
from mrbokeh.optics.camera import Camera
from mrbokeh.system.errors import InputError
from tests.support.plane_sweep_scenes import TracedViews, card, grey_card, traced, wall

PLACES_M = tuple((0.045 * k - 0.12, 0.02 * (-1.0) ** k, 0.004 * k) for k in range(6))
NEW_M = (0.015, 0.004, 0.01)
"""Where no view was taken."""


@pytest.fixture(scope="module")
def views() -> TracedViews:
    """A card at 0.8 m before a wall at 1.6 m, from six places along 22 cm, and from a seventh."""
    return traced((wall(1.6), card(0.8, -0.1, 0.12)), (*PLACES_M, NEW_M), noise=0.005)


def pictures(views: TracedViews) -> list[PosedPicture]:
    return [PosedPicture(rgb, view.camera) for rgb, view in zip(views.rgb, views.views, strict=True)]


@pytest.fixture(scope="module")
def scene(views: TracedViews) -> StillScene:
    return StillScene([each.small() for each in pictures(views)[:-1]], "a card before a wall")


@pytest.fixture(scope="module")
def few(views: TracedViews) -> StillScene:
    """Four of the pictures, the fourth among them."""
    return StillScene([each.small() for each in pictures(views)[1:5]], "cards")


def shares_right(depth: np.ndarray, truth: np.ndarray) -> float:
    return float((np.abs(depth / truth - 1.0) < 0.02).mean())


@pytest.mark.slow
def test_a_picture_that_was_not_swept_has_the_scenes_depth(views: TracedViews, scene: StillScene) -> None:
    """Within 2 %: wrong pixels lie beside the card's edges, where windows of 5 px reach over 4 edges of 112 px in 160x112."""
    found = scene.depth_of(pictures(views)[-1])
    assert shares_right(found.depth, views.depth_m[-1]) > 0.93
    far_from_edges = np.abs(np.gradient(views.depth_m[-1], axis=1)) < 1e-3
    assert shares_right(found.depth[far_from_edges], views.depth_m[-1][far_from_edges]) > 0.95


def test_lengths_are_those_of_the_cameras(views: TracedViews, few: StillScene) -> None:
    """Cameras in millimetres give millimetres, and the same picture."""

    def in_mm(each: PosedPicture) -> PosedPicture:
        pose = each.camera.camera_from_world.copy()
        pose[:3, 3] *= 1000.0
        return replace(each, camera=replace(each.camera, camera_from_world=pose))

    chosen = pictures(views)[1:5]
    millimetres = StillScene([in_mm(each).small() for each in chosen], "cards")
    one, other = few.depth_of(chosen[1]).depth, millimetres.depth_of(in_mm(chosen[1])).depth
    assert (np.abs(other / 1000.0 / one - 1.0) < 1e-3).mean() > 0.97


def test_a_bent_picture_has_depth_at_its_own_pixels(views: TracedViews, few: StillScene) -> None:
    """Barrel distortion of 3 % at the side moves the card's edges by up to 1 px of 160: depth follows the picture."""
    bent, straight = LensDistortion.of("opencv", k1=-0.15), pictures(views)[3]
    at = bent.undistorted_px(straight.camera.pixel_centres_px(), straight.camera) - 0.5
    column, row = np.clip(np.rint(at), 0, (straight.camera.width_px - 1, straight.camera.height_px - 1)).astype(int).transpose(2, 0, 1)
    picture = PosedPicture(straight.rgb[row, column], straight.camera, bent)
    assert shares_right(few.depth_of(picture).depth, views.depth_m[3][row, column]) > 0.92


@pytest.mark.slow
def test_what_moves_by_itself_has_the_depth_behind_it() -> None:
    """A grey card that stands elsewhere in each view is nowhere in space: it gets about the wall's 1.6 m, which others see."""
    still_m = traced((wall(1.6), card(0.8, -0.4, -0.15)), (PLACES_M[3],)).depth_m[0]
    moving = [
        traced((wall(1.6), card(0.8, -0.4, -0.15), grey_card(1.0, 0.02 + shift, 0.14 + shift)), (place,))
        for place, shift in zip(PLACES_M, np.random.default_rng(5).uniform(-0.1, 0.1, len(PLACES_M)), strict=True)
    ]
    posed = [PosedPicture(each.rgb[0], each.views[0].camera) for each in moving]
    found = StillScene([each.small() for each in posed], "a moving card").depth_of(posed[3])
    on_card = moving[3].depth_m[0] < still_m - 0.1
    assert on_card.sum() > 500
    assert np.median(found.depth[on_card]) == pytest.approx(1.6, abs=0.1)


@pytest.mark.slow
def test_what_is_too_far_for_parallax_lies_far_behind() -> None:
    """A wall at 60 m, before which 22 cm give 0.6 px of parallax: it was part of the card at 0.8 m while no plane so far was swept."""
    behind = replace(wall(1.6), corner_m=(-75.0, -75.0, 60.0), edge_u_m=(150.0, 0.0, 0.0), edge_v_m=(0.0, 150.0, 0.0))
    far = traced((behind, card(0.8, -0.1, 0.12)), PLACES_M[:5])
    posed = pictures(far)
    found = StillScene([each.small() for each in posed], "a far wall").depth_of(posed[2]).depth
    on_wall = far.depth_m[2] > 10.0
    assert np.median(found[on_wall]) > 10.0
    assert np.median(found[~on_wall]) == pytest.approx(0.8, rel=0.02)


def test_a_camera_that_only_turns_is_refused(views: TracedViews) -> None:
    with pytest.raises(InputError, match="moves sideways"):
        StillScene([pictures(views)[0].small()] * 3, "clip.mp4")


def test_points_lie_on_the_surfaces(views: TracedViews) -> None:
    """At an angle of 2 degrees a third of a pixel (0.1 degrees here) is 5 % of the depth; points on edges may be either's."""
    points = common_points(views.views)
    camera, depth_m = views.views[0].camera, views.depth_m[0]
    xy_px, depth = camera.project(points)
    column, row = np.floor(xy_px).astype(int).T
    inside = (column >= 0) & (column < camera.width_px) & (row >= 0) & (row < camera.height_px)
    off = np.abs(depth[inside] / depth_m[row[inside], column[inside]] - 1.0)
    assert inside.sum() > 100
    assert (off < 0.02).mean() > 0.75
    assert np.median(off) < 0.01
    farthest, nearest = dioptre_range(camera, points) or (0.0, 0.0)
    assert farthest < 1.0 / 1.6 < 1.0 / 0.8 < nearest


def test_neighbours_are_those_with_parallax(views: TracedViews) -> None:
    """Of views 4 to 22 cm apart before things at 0.8 to 1.6 m, 8 degrees are those about 16 cm apart."""
    chosen = best_neighbours(0, [each.camera for each in views.views], common_points(views.views), 3)
    assert all(0.1 < views.views[k].camera.world_from_camera[0, 3] + 0.12 < 0.25 for k in chosen)


def plainly_carried(source: ViewDepth, view: SweepView, least: float) -> tuple[np.ndarray, np.ndarray]:
    """Carry one pixel at a time through space."""
    there, trust = np.zeros(view.structure.shape, np.float32), np.zeros(view.structure.shape, np.float32)
    rays, pose = rays_of(source.view), neighbour_from_reference(source.view.camera, view.camera)
    for y, x in np.argwhere(source.confidence >= least):
        point = np.array([*rays[y, x], 1.0]) / source.dioptre[y, x]
        point = pose[:3, :3] @ point + pose[:3, 3]
        column, row = point[:2] / point[2] * view.camera.focal_px + view.camera.principal_px - 0.5
        for j in (int(np.floor(row)), int(np.floor(row)) + 1):
            for i in (int(np.floor(column)), int(np.floor(column)) + 1):
                if 0 <= j < there.shape[0] and 0 <= i < there.shape[1] and 1.0 / point[2] > there[j, i]:
                    there[j, i], trust[j, i] = 1.0 / point[2], source.confidence[y, x]
    return there, trust


def of_truth(views: TracedViews, index: int, confidence: float = 0.6) -> ViewDepth:
    dioptre = (1.0 / views.depth_m[index]).astype(np.float32)
    return ViewDepth(views.views[index], dioptre, np.full_like(dioptre, confidence))


def test_carrying_agrees_with_points_carried_one_by_one(views: TracedViews) -> None:
    source, view = of_truth(views, 1), views.views[5]
    source.confidence[::3] = 0.1
    there, trust = (np.zeros(view.structure.shape, np.float32) for _ in range(2))
    carry(rays_of(source.view), source.dioptre, source.confidence, packed_view(source.view, view), np.float32(0.15), there, trust)
    plain, plain_trust = plainly_carried(source, view, 0.15)
    # Points that fall on the border between two pixels may round to either.
    assert (np.abs(there - plain) < 1e-4).mean() > 0.999
    assert (np.abs(trust - plain_trust) < 1e-6).mean() > 0.999


def test_of_two_surfaces_the_nearest_that_is_vouched_for_stays(views: TracedViews) -> None:
    """What one source has made up, with a fourth of the votes, goes wherever another sees something; what hides the wall stays."""
    sources = [of_truth(views, k) for k in (0, 1, 3, 5)]
    made_up = replace(of_truth(views, 4, 0.25), dioptre=np.full_like(sources[0].dioptre, 1.0 / 0.5))
    dioptre, confidence = fused(views.views[-1], [*sources, made_up], 0.015)
    truth = 1.0 / views.depth_m[-1]
    known = confidence > 0
    assert known.mean() > 0.97
    assert (np.abs(dioptre - truth)[known] < 0.015).mean() > 0.97


def test_neighbours_that_see_through_a_surface_take_its_confidence(views: TracedViews) -> None:
    """A wall taken for 0.5 m is seen through by all; the true one is vouched for."""
    neighbours = [of_truth(views, k) for k in (0, 2, 5)]
    false = replace(of_truth(views, 4), dioptre=np.full_like(neighbours[0].dioptre, 1.0 / 0.5))
    assert np.median(vouched(false, neighbours, 0.015).confidence) == pytest.approx(0.2 * 0.3 * 0.6)
    assert np.median(vouched(of_truth(views, 4), neighbours, 0.015).confidence) == pytest.approx(1.0 - 0.4 * 0.5**2)


def test_distance_between_views_counts_turning_and_going() -> None:
    """Of a 90-degree picture: half the width for 45 degrees (in focal lengths), and a step of a quarter of the depth an eighth of it."""
    camera = Camera(100, 100, (50.0, 50.0), (50.0, 50.0))
    turned, moved = (camera.camera_from_world.copy() for _ in range(2))
    turned[:3, :3] = [[np.cos(0.4), 0, -np.sin(0.4)], [0, 1, 0], [np.sin(0.4), 0, np.cos(0.4)]]
    moved[:3, 3] = 0.0, -0.5, 0.0
    assert apart_in_widths(camera, replace(camera, camera_from_world=turned), 2.0) == pytest.approx(0.4 * 0.5)
    assert apart_in_widths(camera, replace(camera, camera_from_world=moved), 2.0) == pytest.approx(0.25 * 0.5)
