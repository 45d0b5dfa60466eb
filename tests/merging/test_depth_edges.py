"""Edges of depth from focus where the all-in-focus picture has them, in pictures small and large."""

from dataclasses import replace

import cv2
import numpy as np
import pytest

from capture.merging.depth_edges import with_edges_of_light
from capture.merging.depth_from_focus import FocusMap

RED, GREEN = (0.5, 0.15, 0.1), (0.1, 0.5, 0.2)
NOISE = 0.02


def disc(size: tuple[int, int], wider_px: int = 0) -> np.ndarray:
    rows, columns = np.mgrid[: size[0], : size[1]]
    return np.hypot(rows - size[0] / 2, columns - size[1] / 2) < size[0] / 4 + wider_px


def picture(near: np.ndarray) -> np.ndarray:
    noise = np.random.default_rng(0).normal(0.0, NOISE, (*near.shape, 3))
    return np.clip(np.where(near[..., None], RED, GREEN) + noise, 0.0, 1.0).astype(np.float32)


@pytest.mark.parametrize(("size", "near_index", "far_index"), [((240, 320), 1, 7), ((240, 320), 7, 1), ((720, 960), 1, 7)])
@pytest.mark.parametrize("wider_px", [0, 6])
def test_a_near_disc_is_as_wide_as_its_colour(size: tuple[int, int], near_index: int, far_index: int, wider_px: int) -> None:
    """Beyond 0.6 million pixels edges are moved in two pictures: what the small one leaves must not stay in the large one."""
    near, wide = disc(size), disc(size, wider_px)
    index = np.where(wide, np.float32(near_index), np.float32(far_index))
    focus = FocusMap(index, np.full(size, 0.5, np.float32))
    found = with_edges_of_light(focus, picture(near), near_first=near_index < far_index).focus_index
    wrong = (np.abs(found - near_index) < np.abs(found - far_index)) != near
    beside = cv2.dilate(near.astype(np.uint8), np.ones((5, 5))) != cv2.erode(near.astype(np.uint8), np.ones((5, 5)))
    assert not wrong[~beside].any(), "nothing is left or taken away more than two pixels from the edge"
    assert wrong.sum() < 0.5 * np.pi * size[0] / 2, "half a pixel all around at most"


def test_two_slices_are_not_evened_out_into_one() -> None:
    """A far surface that is sure would draw an unsure near one of nearly its colour over to itself."""
    near = disc((120, 160))
    rgb = np.where(near[..., None], (0.30, 0.31, 0.30), (0.31, 0.30, 0.30)).astype(np.float32)
    focus = FocusMap((~near).astype(np.float32), np.where(near, np.float32(0.02), np.float32(1.0)))
    found = with_edges_of_light(focus, rgb, near_first=True).focus_index
    assert found[near].max() < 0.5


def test_a_plain_wall_beside_a_near_thing_has_the_depth_of_its_detail_farther_off() -> None:
    """What the wall beside the thing was taken for is a guess; crumbs of confidence in the middle of it change nothing."""
    near = disc((240, 320))
    guess = disc((240, 320), 40) & ~near
    crumb = disc((240, 320), 25) & ~disc((240, 320), 15) & (np.indices(near.shape) % 11 == 0).all(axis=0)
    index = np.where(near | guess, np.float32(1.0), np.float32(7.0))
    confidence = np.where(guess & ~crumb, 0.0, np.where(crumb, 0.2, 0.8)).astype(np.float32)
    rgb = np.where(near[..., None], RED, GREEN).astype(np.float32)
    found = with_edges_of_light(FocusMap(index, confidence), rgb, near_first=True).focus_index
    assert found[guess].min() > 6.0 and (found[near] > 2.0).mean() < 0.001


def test_a_light_keeps_its_own_depth_before_another_surface() -> None:
    """It has no confidence, as its disc is no detail, but its slice is measured."""
    near = disc((240, 320))
    index = np.where(near, np.float32(2.0), np.float32(7.0))
    focus = FocusMap(index, np.where(near, np.float32(0.0), np.float32(0.8)), lit=near)
    even = np.full((240, 320, 3), 0.3, np.float32)
    found = with_edges_of_light(focus, even, near_first=True).focus_index[near]
    lost = with_edges_of_light(replace(focus, lit=None), even, near_first=True).focus_index[near]
    assert np.median(found) == pytest.approx(2.0, abs=0.1) and np.median(lost) > 5.0
