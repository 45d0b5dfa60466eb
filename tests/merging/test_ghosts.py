"""What moved between slices: cut out of the picture whole or left whole, and nothing else touched."""

import itertools
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from capture.cli import app
from capture.merging.all_in_focus import BandBlend, sharp_all_in_focus
from capture.merging.depth_from_focus import FocusMap, focus_map
from capture.merging.focus_volume import focus_volume
from capture.merging.ghosts import LEAST_SHARE, MOVED_CONFIDENCE, UNLIKE, Likeness, Mended, _Cut, unlike_slices, without_ghosts
from capture.merging.lights import no_lights
from capture.merging.merge import GHOSTS
from capture.merging.registration.registration_file import Registration, write_registration
from capture.stacks.ingest import ingest
from mrbokeh.images.image_io import write_image
from mrbokeh.stacks.focal_stack import read_focal_stack
from tests.support.command_line import printed_by
from tests.support.made_photographs import only_stack

SHAPE = (240, 360)
TILE_PX, WALKER_PX, MIDDLE_PX = 48, 45, 180
"""Tiles of the scene are sharp in slice 0 and in slice 2 in turn; somebody of this radius walks before them."""


def walls() -> np.ndarray:
    noise = np.random.default_rng(3).uniform(0.0, 1.0, (*SHAPE, 3)).astype(np.float32)
    return np.clip(0.3 + 1.5 * (cv2.GaussianBlur(noise, (0, 0), 1.0) - 0.5), 0.02, 0.9)


def walker(x_px: float, y_px: float = 120.0) -> np.ndarray:
    """(H, W, 1) 1 where somebody dark stands."""
    y, x = np.mgrid[: SHAPE[0], : SHAPE[1]]
    return cv2.GaussianBlur((np.hypot(x - x_px, y - y_px) < WALKER_PX).astype(np.float32), (0, 0), 1.0)[..., None]


def still() -> list[np.ndarray]:
    y, x = np.mgrid[: SHAPE[0], : SHAPE[1]]
    wall, near_tile = walls(), ((x // TILE_PX + y // TILE_PX) % 2 == 0)[..., None]
    far, farther = cv2.GaussianBlur(wall, (0, 0), 1.5), cv2.GaussianBlur(wall, (0, 0), 3.0)
    return [np.where(near_tile, near, away) for near, away in ((wall, farther), (far, far), (farther, wall))]


def walked() -> list[np.ndarray]:
    """Slices in which somebody walks by, by two thirds of himself."""
    return [rgb * (1.0 - walker(x_px)) + 0.02 * walker(x_px) for rgb, x_px in zip(still(), (150, MIDDLE_PX, 210), strict=True)]


def merged(slices: list[np.ndarray]) -> np.ndarray:
    volume = focus_volume(iter(slices))
    return sharp_all_in_focus(lambda: iter(slices), focus_map(volume, no_lights(volume.shape)).focus_index, volume)


def mended(picture: np.ndarray, slices: list[np.ndarray], valid: list[np.ndarray] | None = None) -> Mended | None:
    masks = valid or [np.ones(SHAPE, bool)] * len(slices)
    return without_ghosts(picture, lambda: iter(slices), lambda: zip(slices, masks, strict=True), lambda rgb: rgb)


def share_unlike(picture: np.ndarray, slices: list[np.ndarray]) -> float:
    return float((unlike_slices(picture, [(rgb, np.ones(SHAPE, bool)) for rgb in slices]) > UNLIKE).mean())


def test_a_transparent_walker_is_whole_or_gone() -> None:
    """Merging mixes him with the wall behind; afterwards each place is as some slice shows it, and what is far from him stays as it was."""
    slices = walked()
    picture = merged(slices)
    found = mended(picture, slices)
    assert found is not None and found.before > 0.02 and found.after < LEAST_SHARE
    assert found.before == pytest.approx(share_unlike(picture, slices), abs=1e-9)
    assert found.after == pytest.approx(share_unlike(found.picture, slices), abs=1e-9)
    beyond = ~BandBlend(SHAPE).reached((found.chosen >= 0).astype(np.float32))
    assert beyond.any()
    np.testing.assert_array_equal(found.picture[beyond], picture[beyond])


def test_what_stands_still_is_left_alone() -> None:
    slices = still()
    assert mended(merged(slices), slices) is None


def half_there() -> tuple[list[np.ndarray], np.ndarray, np.ndarray]:
    """(slices of which the second alone shows somebody, the picture in which he is transparent, where he is)."""
    slices, there = still(), walker(MIDDLE_PX)
    slices[1] = slices[1] * (1.0 - there) + 0.02 * there
    picture = np.where(there > 0, 0.5 * merged(still()) + 0.5 * slices[1], merged(still())).astype(np.float32)
    return slices, picture, there[..., 0] > 0.5


def test_somebody_is_there_with_all_of_him_or_not_at_all() -> None:
    slices, picture, there = half_there()
    found = mended(picture, slices)
    assert found is not None
    assert len(set((found.chosen[there] == 1).tolist())) == 1


def test_what_is_seen_anew_has_the_depth_of_its_slice() -> None:
    """Somebody whose rim was transparent is gone with his middle, which a slice shows: the wall has its depth there, with little
    confidence, and what stayed has what it had."""
    slices, picture, there = half_there()
    middle = cv2.erode(there.astype(np.uint8), np.ones((31, 31), np.uint8)) > 0
    picture[middle] = slices[1][middle]
    found = mended(picture, slices)
    assert found is not None and (found.chosen[there] % 2 == 0).all()
    placed = found.placed(FocusMap(np.full(SHAPE, 0.5, np.float32), np.where(there, 1.0, 0.9).astype(np.float32)))
    inside = cv2.erode(there.astype(np.uint8), np.ones((9, 9), np.uint8)) > 0
    np.testing.assert_array_equal(placed.focus_index[inside], np.where(found.sharp, found.chosen, 0.5)[inside])
    y, x = np.mgrid[: SHAPE[0], : SHAPE[1]]
    its_own = np.where((x // TILE_PX + y // TILE_PX) % 2 == 0, 0, 2)
    within = inside & (np.minimum(x % TILE_PX, y % TILE_PX) >= 16) & (np.maximum(x % TILE_PX, y % TILE_PX) < TILE_PX - 16)
    np.testing.assert_array_equal(found.sharp[within], (found.chosen == its_own)[within])
    assert (placed.confidence[inside] == np.float32(MOVED_CONFIDENCE)).all()
    stays = found.chosen < 0
    assert (placed.focus_index[stays] == 0.5).all() and placed.confidence[stays].min() > 0.8
    unsure = found.placed(FocusMap(np.full(SHAPE, 0.5, np.float32), np.zeros(SHAPE, np.float32)))
    assert (unsure.confidence == 0.0).all()


def test_a_slice_without_data_gives_nothing() -> None:
    """Where slice 1 has no data he is gone, and where it alone has some he stays."""
    slices, picture, there = half_there()
    around = np.ones(SHAPE, bool)
    around[60:180, 120:240] = False
    for without in ((1,), (0, 2)):
        found = mended(picture, slices, [around if index in without else np.ones(SHAPE, bool) for index in range(3)])
        assert found is not None
        assert set(found.chosen[there].tolist()).isdisjoint({*without, -1})


def test_what_a_slice_repeats_beyond_its_data_is_not_like_it() -> None:
    picture = walls()
    likeness = Likeness(picture)
    likeness.add(picture, np.zeros(SHAPE, bool))
    likeness.add(np.float32(0.2) * picture, np.ones(SHAPE, bool))
    assert likeness.unlike().min() > UNLIKE


def test_brightness_goes_over_without_a_step() -> None:
    """Slice 1 is a tenth brighter. Between what is taken of it and what stays no neighbours on the plain wall differ by a third of that."""
    slices, there = [np.full((*SHAPE, 3), light, np.float32) for light in (0.4, 0.44, 0.4)], walker(MIDDLE_PX)
    picture = (slices[0] * (1.0 - 0.5 * there) + 0.01 * there).astype(np.float32)
    for index in (0, 2):
        slices[index] = slices[index] * (1.0 - there) + 0.02 * there
    known = np.ones(SHAPE, bool)
    known[60:180, 120:240] = False
    found = mended(picture, slices, [known, np.ones(SHAPE, bool), known])
    assert found is not None and (found.chosen == 1).any()
    assert np.abs(np.diff(found.picture[:40], axis=1)).max() < 0.013 and np.abs(np.diff(found.picture[115], axis=0)).max() < 0.013


def test_a_cut_lies_where_two_slices_agree() -> None:
    """Three cells below one another: the first must change and the last must stay; the labels show the same in the last alone."""
    shown = np.full((2, 3, 4, 3), 100, np.uint8)
    shown[1, :2] = 180
    costs = np.array([[30.0, 0.0, 0.0], [0.0, 0.5, 30.0]])
    np.testing.assert_array_equal(_Cut((3, 1), costs, shown).labels(), [1, 1, 0])
    shown[1] = shown[0]
    np.testing.assert_array_equal(_Cut((3, 1), costs, shown).labels(), [1, 0, 0])


def made_cut(seed: int, labels: int) -> _Cut:
    rng = np.random.default_rng(seed)
    return _Cut((2, 3), rng.uniform(0.0, 3.0, (labels, 6)), rng.integers(0, 40, (labels, 6, 4, 3), np.uint8))


def cost(cut: _Cut, labels: np.ndarray) -> float:
    """What labels cost together, cell by cell: a seam of 3 % of white in a cell costs 1, and 0.02 for its length."""
    rows, columns = cut.shape
    total = sum(float(cut.costs[label, cell]) for cell, label in enumerate(labels))
    for cell, other in itertools.combinations(range(rows * columns), 2):
        beside = other == cell + 1 and other % columns > 0
        if (beside or other == cell + columns) and labels[cell] != labels[other]:
            for place in (cell, other):
                apart = np.abs(cut.shown[labels[cell], place].astype(float) - cut.shown[labels[other], place])
                total += apart.max(axis=1).mean() / 255.0 / 0.03
            total += 0.02
    return total


def test_an_expansion_is_the_cheapest_of_all() -> None:
    """Each of 6 cells keeps its label or takes the new one: 64 ways are tried one by one. Costs are rounded to thousandths."""
    for seed in range(9):
        cut, label = made_cut(seed, 3), seed % 3
        labels = np.random.default_rng(seed).integers(0, 3, 6)
        ways = (np.where(each, label, labels) for each in itertools.product((False, True), repeat=6))
        assert cost(cut, cut._expanded(labels, label)) == pytest.approx(min(cost(cut, each) for each in ways), abs=0.01)


def test_the_cut_is_among_the_cheapest() -> None:
    """Expansion is within twice the least of all labellings (Boykov et al. 2001), exact of two labels; alike, each takes its cheapest."""
    for seed in range(5):
        for count, factor in ((2, 1.0), (3, 2.0)):
            cut = made_cut(seed, count)
            cheapest = min(cost(cut, np.array(each)) for each in itertools.product(range(count), repeat=6))
            assert cost(cut, cut.labels()) <= factor * cheapest + 0.01
        alike = replace(cut, shown=np.broadcast_to(cut.shown[:1], cut.shown.shape), costs=10.0 * cut.costs)
        np.testing.assert_array_equal(alike.labels(), alike.costs.argmin(axis=0))


def test_merging_cuts_it_out_and_says_so(tmp_path: Path) -> None:
    """What is preferred where two things are sharp does not bring it back: who moved and what he hid are two."""
    for index, rgb in enumerate(walked()):
        write_image(tmp_path / "shoot" / f"{index}.png", rgb)
    stack = only_stack(ingest([tmp_path / "shoot"], tmp_path / "scene"))
    identity = np.array([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
    write_registration(tmp_path / "unmoved.json", Registration(0, (identity,) * 3, (1.0,) * 2, (0.0,) * 3))
    told = printed_by(app, "merge", str(stack.folder), "--registration", str(tmp_path / "unmoved.json"), "--prefer", "near")
    done = read_focal_stack(stack.folder)
    found = done.metadata[GHOSTS]
    assert found["before"] > LEAST_SHARE > found["after"] and 0.0 < found["share"] < 0.8
    assert f"something moved between the slices: {found['share']:.1%} of the picture is taken whole from one slice each" in told
    assert share_unlike(done.all_in_focus(), [done.slice_rgb(index) for index in range(3)]) < LEAST_SHARE
