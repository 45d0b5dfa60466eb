"""What moved between slices: cut out of the picture whole or left whole, and nothing else touched."""

import itertools
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from capture.cli import app
from capture.merging.all_in_focus import sharp_all_in_focus
from capture.merging.depth_from_focus import FocusMap, focus_map
from capture.merging.focus_volume import focus_volume
from capture.merging.ghosts import LEAST_SHARE, MOVED_CONFIDENCE, UNLIKE, Likeness, Mended, _Cut, without_ghosts
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


def everywhere(_index: int) -> np.ndarray:
    return np.ones(SHAPE, bool)


def as_is(rgb: np.ndarray) -> np.ndarray:
    return rgb


def merged(slices: list[np.ndarray]) -> np.ndarray:
    volume = focus_volume(iter(slices))
    return sharp_all_in_focus(lambda: iter(slices), focus_map(volume, no_lights(volume.shape)).focus_index, volume)


def mended(picture: np.ndarray, slices: list[np.ndarray]) -> Mended | None:
    return without_ghosts(picture, lambda: iter(slices), everywhere, as_is)


def share_unlike(picture: np.ndarray, slices: list[np.ndarray]) -> float:
    likeness = Likeness(picture)
    for rgb in slices:
        likeness.add(rgb, everywhere(0))
    return float((likeness.unlike() > UNLIKE).mean())


def test_a_transparent_walker_is_whole_or_gone() -> None:
    """Merging mixes him with the wall behind; afterwards each place is as some slice shows it, and what is far from him stays as it was."""
    slices = walked()
    picture = merged(slices)
    found = mended(picture, slices)
    assert found is not None and found.before > 0.02 and found.after < LEAST_SHARE
    assert found.before == pytest.approx(share_unlike(picture, slices), abs=1e-9)
    assert found.after == pytest.approx(share_unlike(found.picture, slices), abs=1e-9)
    np.testing.assert_allclose(found.picture[:20], picture[:20], atol=1e-4)
    assert (found.chosen[:20] == -1).all() and found.moved[80:160, 140:220].any()


def test_what_stands_still_is_left_alone() -> None:
    slices = still()
    assert mended(merged(slices), slices) is None


def test_seams_go_where_slices_agree() -> None:
    """Somebody whom one slice shows is there with all of him or not at all: cut in two he would have a border as dark as he is bright."""
    slices, there = still(), walker(MIDDLE_PX)
    slices[1] = slices[1] * (1.0 - there) + 0.02 * there
    picture = np.where(there > 0, 0.5 * merged(still()) + 0.5 * slices[1], merged(still())).astype(np.float32)
    found = mended(picture, slices)
    assert found is not None
    inside = found.chosen[there[..., 0] > 0.5] == 1
    assert inside.all() or not inside.any()


def test_what_moved_has_the_depth_of_its_slice() -> None:
    chosen, moved = np.full((2, 3), -1, np.int16), np.zeros((2, 3), bool)
    chosen[0], moved[:, 0] = 2, True
    focus = FocusMap(np.full((2, 3), 0.5, np.float32), np.ones((2, 3), np.float32))
    found = Mended(picture=np.zeros((2, 3, 3), np.float32), before=0.1, after=0.0, chosen=chosen, moved=moved)
    placed = found.placed(focus)
    np.testing.assert_array_equal(placed.focus_index, [[2.0, 0.5, 0.5], [0.5, 0.5, 0.5]])
    np.testing.assert_allclose(placed.confidence, [[MOVED_CONFIDENCE, 1.0, 1.0], [1.0, 1.0, 1.0]])


def test_a_slice_without_data_gives_nothing() -> None:
    """Somebody stands in slice 1 alone. Where that has no data he is gone, and where it alone has some he stays."""
    slices, there = still(), walker(MIDDLE_PX)
    slices[1] = slices[1] * (1.0 - there) + 0.02 * there
    picture = np.where(there > 0, 0.5 * merged(still()) + 0.5 * slices[1], merged(still())).astype(np.float32)
    around = np.ones(SHAPE, bool)
    around[60:180, 120:240] = False
    for without in ((1,), (0, 2)):
        masks = [around if index in without else everywhere(index) for index in range(3)]
        found = without_ghosts(picture, lambda: iter(slices), masks.__getitem__, as_is)
        assert found is not None
        assert set(found.chosen[there[..., 0] > 0.5].tolist()).isdisjoint({*without, -1})


def test_what_a_slice_repeats_beyond_its_data_is_not_like_it() -> None:
    picture = walls()
    likeness = Likeness(picture)
    likeness.add(picture, np.zeros(SHAPE, bool))
    likeness.add(np.float32(0.2) * picture, everywhere(1))
    assert likeness.unlike().min() > UNLIKE


def made_cut(seed: int, labels: int) -> _Cut:
    rng = np.random.default_rng(seed)
    return _Cut((2, 3), rng.uniform(0.0, 3.0, (labels, 6)), rng.integers(0, 40, (labels, 6, 4, 3), np.uint8))


def test_an_expansion_is_the_cheapest_of_all() -> None:
    """Each of 6 cells keeps its label or takes the new one: 64 ways are tried one by one. Costs are rounded to thousandths."""
    for seed in range(9):
        cut, label = made_cut(seed, 3), seed % 3
        labels = np.random.default_rng(seed).integers(0, 3, 6)
        ways = (np.where(each, label, labels) for each in itertools.product((False, True), repeat=6))
        assert cut.cost(cut._expanded(labels, label)) == pytest.approx(min(map(cut.cost, ways)), abs=0.01)


def test_the_cut_is_among_the_cheapest() -> None:
    """Expansion is within twice the least of all labellings (Boykov et al. 2001), exact of two labels; alike, each takes its cheapest."""
    for seed in range(5):
        for count, factor in ((2, 1.0), (3, 2.0)):
            cut = made_cut(seed, count)
            cheapest = min(cut.cost(np.array(each)) for each in itertools.product(range(count), repeat=6))
            assert cut.cost(cut.labels()) <= factor * cheapest + 0.01
        alike = replace(cut, seen=np.broadcast_to(cut.seen[:1], cut.seen.shape), costs=10.0 * cut.costs)
        np.testing.assert_array_equal(alike.labels(), alike.costs.argmin(axis=0))


def test_merging_cuts_it_out_and_says_so(tmp_path: Path) -> None:
    for index, rgb in enumerate(walked()):
        write_image(tmp_path / "shoot" / f"{index}.png", rgb)
    stack = only_stack(ingest([tmp_path / "shoot"], tmp_path / "scene"))
    identity = np.array([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
    write_registration(tmp_path / "unmoved.json", Registration(0, (identity,) * 3, (1.0,) * 2, (0.0,) * 3))
    told = printed_by(app, "merge", str(stack.folder), "--registration", str(tmp_path / "unmoved.json"))
    done = read_focal_stack(stack.folder)
    found = done.metadata[GHOSTS]
    assert found["before"] > LEAST_SHARE > found["after"] and 0.0 < found["share"] < 0.8
    assert f"something moved between the slices: {found['share']:.0%} of the picture is taken whole from one slice each" in told
    assert share_unlike(done.all_in_focus(), [done.slice_rgb(index) for index in range(3)]) < LEAST_SHARE
