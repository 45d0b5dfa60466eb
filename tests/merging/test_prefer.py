"""Which of two things that are sharp in one place a merge shows: threads before a wall, and a wall alone that nothing may change."""

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from capture.merging.depth_from_focus import focus_map
from capture.merging.focus_volume import focus_volume
from capture.merging.lights import no_lights
from capture.merging.merge import merge_scene
from capture.merging.preferred_side import (
    PREFERRED,
    Preferred,
    Side,
    blended,
    first_of_two_peaks,
    nearest_end,
    preferred_lines,
    preferred_places,
)
from mrbokeh.images.exr_io import read_exr
from mrbokeh.stacks.focal_stack import FocalStack, Slice
from tests.support.blended_slices import all_in_focus
from tests.support.crossing_stack import DISTANCES_M, FAR, NEAR, SIZE, THREAD, crossing_slices, crossing_stack, threads, unmoved, wall

INSIDE = (slice(12, -12), slice(12, -12))


def preferred(slices: list[np.ndarray], from_first: bool) -> tuple[Preferred, np.ndarray, np.ndarray]:
    """(what is preferred, the picture without it, the picture with it)."""
    volume = focus_volume(slices)
    index = focus_map(volume, no_lights(volume.shape)).focus_index
    plain = all_in_focus(slices, index)
    found = preferred_places(slices, volume, index, from_first, np.zeros(index.shape, bool))
    return found, plain, blended(plain, slices, found)


def test_two_peaks_are_told_from_one_and_from_noise() -> None:
    """Energies in noise floors, 9 slices: one peak; two; two that stand on one another; the second no higher than noise."""
    rows = np.array(
        [[1, 5, 200, 5, 1, 1, 1, 1, 1], [1, 200, 9, 1, 1, 9, 200, 9, 1], [1, 200, 150, 150, 200, 9, 1, 1, 1], [1, 9, 200, 9, 1, 1, 9, 1, 1]]
    )
    energies = np.repeat(np.repeat(rows.T[:, :, None].astype(np.float32), 40, axis=1), 40, axis=2)
    for from_first, slice_of_two in ((True, 1), (False, 6)):
        found = first_of_two_peaks(energies, from_first)
        assert [found[20 + 40 * row, 20] for row in range(4)] == [-1, slice_of_two, -1, -1]


def test_near_threads_run_before_a_wall_that_is_sharp_beside_them() -> None:
    """Without a preference the window of the energy, 6 px to either side, takes the wall beside a thread from the thread's slice."""
    found, plain, shown = preferred(crossing_slices(), from_first=True)
    truth = np.where(threads()[..., None] > 0, np.float32(THREAD), wall())
    on_threads, beside = threads() > 0, (cv2.dilate(threads(), np.ones((13, 13))) > 0) & (cv2.dilate(threads(), np.ones((3, 3))) == 0)
    assert np.abs(found.index[on_threads] - NEAR).mean() < 0.2
    assert np.abs(shown - truth)[on_threads].mean() < 0.05
    # What remains is light of the blurred thread, which the wall's slice has there.
    assert detail_error(shown, truth, beside) < 0.9 * detail_error(plain, truth, beside) < 0.06


def test_a_far_wall_is_seen_through_the_threads() -> None:
    """In the wall's slice a thread is spread over 2 x 6.4 px and lets most of the wall through."""
    found, plain, shown = preferred(crossing_slices(), from_first=False)
    on_threads = threads()[INSIDE] > 0
    assert np.abs(found.index[INSIDE][on_threads] - FAR).mean() < 0.3
    assert np.median(shown[INSIDE][on_threads]) < 0.6 * THREAD < 0.9 * np.median(plain[INSIDE][on_threads])
    inside = np.zeros(SIZE, bool)
    inside[INSIDE] = on_threads
    assert detail_error(shown, wall(), inside) < 0.7 * detail_error(plain, wall(), inside)


def detail_error(rgb: np.ndarray, truth: np.ndarray, where: np.ndarray) -> float:
    """Root mean square of what is wrong at the scale of pixels."""
    fine = [each - cv2.GaussianBlur(each, (0, 0), 2.0) for each in (rgb, truth)]
    return float(np.sqrt(((fine[0] - fine[1])[where] ** 2).mean()))


def test_far_from_the_threads_nothing_changes() -> None:
    """The wide window with its smoothing ends 12 px away; the blend reaches further, and changes nothing that can be seen."""
    far_off = cv2.dilate(threads(), np.ones((33, 33))) == 0
    for from_first in (True, False):
        found, plain, shown = preferred(crossing_slices(), from_first)
        assert not found.where[far_off].any()
        assert np.abs(shown - plain)[far_off].mean() < 0.01


def test_a_wall_alone_is_untouched() -> None:
    for from_first in (True, False):
        found, plain, shown = preferred(crossing_slices(has_threads=False), from_first)
        assert not found.where.any()
        np.testing.assert_array_equal(shown, plain)


def test_beyond_the_reach_of_the_blend_every_bit_stays() -> None:
    slices = crossing_slices()
    plain = slices[FAR]
    where = np.zeros(SIZE, bool)
    where[60:70, 10:20] = True
    shown = blended(plain, slices, Preferred(where, np.where(where, NEAR, FAR).astype(np.float32)))
    assert np.abs(shown - plain)[60:70, 10:20].max() > 0.05
    np.testing.assert_array_equal(shown[:, 90:], plain[:, 90:])


def merged(folder: Path, prefer: Side | None = None) -> FocalStack:
    return merge_scene(folder, overwrite=True, registration=unmoved(folder.parent), prefer=prefer)[0]


def test_a_merge_of_one_surface_is_the_same_with_every_preference(tmp_path: Path) -> None:
    folder = crossing_stack(tmp_path, has_threads=False).folder
    plain = merged(folder)
    picture, depth = plain.all_in_focus(), read_exr(plain.depth_path)[0].channels
    sides: tuple[Side, ...] = ("near", "far")
    for side in sides:
        again = merged(folder, side)
        np.testing.assert_array_equal(again.all_in_focus(), picture)
        for name, values in read_exr(again.depth_path)[0].channels.items():
            np.testing.assert_array_equal(values, depth[name], err_msg=name)
        assert again.metadata[PREFERRED]["share"] == 0.0
        assert "nothing changed" in preferred_lines(again)[0]


def test_a_merge_shows_the_preferred_side_and_puts_it_at_its_depth(tmp_path: Path) -> None:
    folder = crossing_stack(tmp_path).folder
    on_threads = threads()[INSIDE] > 0
    near, near_m = (each[INSIDE][on_threads] for each in picture_and_depth(merged(folder, "near")))
    far, far_m = (each[INSIDE][on_threads] for each in picture_and_depth(merged(folder, "far")))
    assert np.median(near_m) == pytest.approx(DISTANCES_M[NEAR], rel=0.02)
    assert np.median(far_m) == pytest.approx(DISTANCES_M[FAR], rel=0.02)
    assert np.median(near) > 0.9 * THREAD > 1.2 * np.median(far)
    assert PREFERRED not in merged(folder).metadata


def picture_and_depth(stack: FocalStack) -> tuple[np.ndarray, np.ndarray]:
    return stack.all_in_focus(), stack.depth_m()


def test_near_and_far_are_told_by_distances_and_a_guess_is_said_to_be_one(tmp_path: Path) -> None:
    first_far = FocalStack(tmp_path, (Slice("0.exr", 2.0), Slice("1.exr", 1.0)), metadata={"metres": {"gauge": {"near_first_sure": False}}})
    assert nearest_end(first_far) == (False, False)
    record = {"side": "near", "share": 0.01, "first_is_near": False, "sure": False}
    lines = preferred_lines(replace(first_far, metadata={PREFERRED: record}))
    assert "1.00%" in lines[0]
    assert "the last slice is the nearest is a guess" in lines[1] and "--prefer far" in lines[1]
    assert nearest_end(replace(first_far, metadata={}))[1], "stated distances are no guess"
