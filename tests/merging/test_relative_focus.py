"""Blur solved from slices alone: positions in pixels against those that the slices were rendered with, order and near end of the sweep."""

import shutil
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path

import cv2
import numpy as np
import pytest

from capture.merging.merge import merge_scene
from capture.merging.metres.blur_evidence import DIAMETERS_PX, DRAWN_PX, disc_kernel
from capture.merging.metres.focus_order import Contours, Direction, focus_order
from capture.merging.metres.relative_focus import RelativeFocus, _Places, solve_relative_focus
from capture.merging.metres.relative_stack import FROM_DISTANCES, gauge_of, stated_direction
from mrbokeh.images.camera_rgb import write_camera_rgb
from mrbokeh.images.exr_io import read_exr
from mrbokeh.images.layer import opaque
from mrbokeh.optics.aperture import Aperture
from mrbokeh.optics.drawn_diameters import drawn_diameters_px
from mrbokeh.optics.lens import Lens
from mrbokeh.renderers.polygon.polygon_differences import PolygonDifferences
from mrbokeh.stacks.focal_stack import FocalStack, Slice, read_focal_stack, write_focal_stack
from tests.project.test_user_mistakes import said
from tests.support.blended_slices import all_in_focus

SIZE = (200, 280)
# Uneven steps of focus, in dioptres, nearest first; 30 px of blur to each: 2.4 to 6 px from one slice to the next.
DIOPTRES = (1.5, 1.3, 1.22, 1.05, 0.9, 0.75)
GROWTH = 30.0
# A card in front of a wall that leans back.
CARD_DIOPTRES = 1.38


@dataclass(frozen=True)
class Rendered:
    """slices, nearest focus first; sharp: all-in-focus truth; dioptres: (H, W) of its surfaces."""

    slices: tuple[np.ndarray, ...]
    sharp: np.ndarray
    dioptres: np.ndarray

    @property
    def index(self) -> np.ndarray:
        """(H, W) the fractional index of the slice in which each pixel is sharp."""
        return np.interp(-self.dioptres, [-each for each in DIOPTRES], np.arange(len(DIOPTRES))).astype(np.float32)


@cache
def rendered(noise: float = 0.0) -> Rendered:
    if noise > 0.0:
        rng, clean = np.random.default_rng(4), rendered()
        noisy = (each + np.float32(noise) * rng.standard_normal(each.shape, np.float32) for each in clean.slices)
        return replace(clean, slices=tuple(noisy))
    rng = np.random.default_rng(3)
    height, width = SIZE
    texture = 0.25 * rng.random((height, width, 3)) + 0.35 * cv2.resize(
        rng.random((height // 5, width // 5, 3)), (width, height), interpolation=cv2.INTER_NEAREST
    )
    dioptres = np.broadcast_to(np.linspace(0.72, 1.25, width), SIZE).copy()
    card = np.s_[40:150, 60:150]
    texture[card] = texture[card] + 0.3
    dioptres[card] = CARD_DIOPTRES
    # A photograph's pixels are means over their area.
    sharp = cv2.GaussianBlur(texture, (0, 0), 0.5).astype(np.float32)
    renderer, layer = PolygonDifferences(threads=1), opaque(sharp, (1.0 / dioptres).astype(np.float32))
    lens = Lens(35.0, 1.0, 1.0, 36.0)
    slices = []
    for each in DIOPTRES:
        focused = lens.focused_at(1.0 / each)
        focused = Lens(35.0, focused.coc_px_per_dioptre(width) / GROWTH, 1.0 / each, 36.0)
        slices.append(renderer.render([layer], focused).rgb)
    return Rendered(tuple(slices), sharp, dioptres.astype(np.float32))


@pytest.mark.parametrize("noise", [0.0, 0.01])
def test_positions_and_surfaces_are_those_of_the_lens(noise: float) -> None:
    scene = rendered(noise)
    merged = all_in_focus(scene.slices, scene.index)
    solved = solve_relative_focus(lambda: scene.slices, merged, scene.index, np.ones(SIZE, np.float32), len(DIOPTRES))
    true_px = -GROWTH * np.array(DIOPTRES)
    # The growth of blur is met to a few per cent, and each slice to a seventh of a pixel besides.
    scale, offset = np.polyfit(solved.positions_px, true_px, 1)
    assert scale == pytest.approx(1.0, abs=0.03)
    assert np.abs(scale * solved.positions_px + offset - true_px).max() < 0.15
    assert (solved.errors_px < 0.5).all()
    off_px = np.abs(scale * solved.focus_px + offset + GROWTH * scene.dioptres)[20:-20, 20:-20]
    assert np.median(off_px) < 0.2, "a twentieth of the mean step"
    assert np.median(off_px / solved.error_px[20:-20, 20:-20]) < 1.5, "errors are of the size that is stated"


def test_misfits_are_those_of_pictures_that_go_over_linearly_between_rungs() -> None:
    rng = np.random.default_rng(5)
    squares_px2 = np.array([0.0, 1.5, 4.0, 9.0])
    slices, ladder = rng.random((2, 3, 50)), rng.random((3, 4, 50))
    errors = ((slices.transpose(1, 0, 2)[:, :, None] - ladder[:, None]) ** 2).mean(axis=3).astype(np.float32)
    gaps = (np.diff(ladder, axis=1) ** 2).mean(axis=2).astype(np.float32)
    nothing = np.zeros(3, np.float32)
    places = _Places(errors, gaps, squares_px2, 1.0, (1, 3), nothing, np.zeros((3, 2), np.float32), nothing)
    for wanted in (-1.0, 0.0, 0.7, 1.5, 3.0, 8.9, 9.0, 12.0):
        blended = np.stack([[np.interp(wanted, squares_px2, column) for column in rungs.T] for rungs in ladder])
        for one in range(2):
            found = places.misfits(np.arange(3), one, np.full((1, 3), wanted))
            np.testing.assert_allclose(found[0], ((slices[one] - blended) ** 2).mean(axis=1), rtol=1e-4)


def test_a_slice_too_many_does_no_harm() -> None:
    """The same photograph twice: two slices of one position, as far as blur below a pixel can be told."""
    scene = rendered()
    twice = (*scene.slices[:3], scene.slices[2], *scene.slices[3:])
    index = np.interp(scene.index, [0, 1, 2, 3, 4, 5], [0, 1, 2.5, 4, 5, 6]).astype(np.float32)
    solved = solve_relative_focus(lambda: twice, all_in_focus(twice, index), index, np.ones(SIZE, np.float32), len(twice))
    assert solved.positions_px[3] - solved.positions_px[2] < 1.0
    true_px = -GROWTH * np.array([*DIOPTRES[:3], DIOPTRES[2], *DIOPTRES[3:]])
    assert np.corrcoef(solved.positions_px, true_px)[0, 1] > 0.998


def test_where_a_slice_has_no_data_it_says_nothing() -> None:
    scene = rendered()
    broken = list(scene.slices)
    broken[1] = broken[1].copy()
    broken[1][:, :100] = 0.0
    known = np.ones(SIZE, bool)
    known[:, :100] = False
    solved = solve_relative_focus(
        lambda: broken,
        scene.sharp,
        scene.index,
        np.ones(SIZE, np.float32),
        len(broken),
        lambda index: known | (index != 1),
    )
    assert np.corrcoef(solved.positions_px, -GROWTH * np.array(DIOPTRES))[0, 1] > 0.998


@pytest.mark.parametrize("far_first", [False, True])
def test_contours_tell_which_end_is_near(far_first: bool) -> None:
    """The card hides the wall: its outline is sharp with the card, whichever slice comes first."""
    scene = rendered()
    slices = scene.slices[::-1] if far_first else scene.slices
    index = (len(DIOPTRES) - 1 - scene.index if far_first else scene.index).astype(np.float32)
    contours = Contours.of(index)
    list(contours.watching(slices))
    positions_px = GROWTH * np.array(DIOPTRES[::-1] if far_first else [-each for each in DIOPTRES])
    found = contours.direction(np.sort(positions_px), [1.0] * len(slices))
    assert found.near_first is not far_first
    assert found.sure and found.source == "contours"


def test_without_contours_the_order_of_files_stands_and_is_called_a_guess() -> None:
    index = np.broadcast_to(np.linspace(0.0, 5.0, SIZE[1], dtype=np.float32), SIZE).copy()
    contours = Contours.of(index)
    list(contours.watching(rendered().slices))
    found = contours.direction(np.arange(6.0), [1.0] * 6)
    assert found.near_first and not found.sure and found.source == "file order"


@pytest.mark.parametrize("seed", range(4))
def test_shuffled_slices_are_put_in_order(seed: int) -> None:
    order = np.random.default_rng(seed).permutation(len(DIOPTRES))
    slices = [rendered(0.01).slices[each] for each in order]
    found = focus_order(lambda index: slices[index], len(slices))
    sorted_as = [int(order[each]) for each in found]
    assert sorted_as in (sorted(sorted_as), sorted(sorted_as)[::-1])


def test_a_right_order_and_a_sweep_there_and_back() -> None:
    slices = rendered(0.01).slices
    as_given = tuple(range(len(slices)))
    assert focus_order(lambda index: slices[index], len(slices)) == as_given
    assert focus_order(lambda index: slices[::-1][index], len(slices)) == as_given, "far first is an order too"
    there_and_back = [0, 2, 4, 5, 3, 1]
    found = focus_order(lambda index: slices[there_and_back[index]], len(slices))
    assert [there_and_back[each] for each in found] in ([0, 1, 2, 3, 4, 5], [5, 4, 3, 2, 1, 0])
    assert focus_order(lambda index: slices[index], 2) == (0, 1)


def test_two_far_slices_are_neighbours_though_the_hand_moved_between_them() -> None:
    """Where both moved by 8 % of the width no order is free of contradictions; with the near one between them it has five times more."""
    near, far, beyond = (rendered(0.01).slices[each] for each in (0, 5, 4))
    moved = [np.roll(far, 24, axis=1), near, np.roll(beyond, -24, axis=1)]
    assert focus_order(lambda index: moved[index], 3) == (0, 2, 1)


def unmerged(folder: Path, order: tuple[int, ...], distances_m: dict[int, float] | None = None, **metadata: object) -> None:
    """A stack as ingested: slices of `rendered` in an order, most or all of them without a distance."""
    slices = []
    for place, each in enumerate(order):
        write_camera_rgb(folder / f"slices/{place:02d}.exr", rendered(0.003).slices[each], None)
        slices.append(Slice(f"slices/{place:02d}.exr", (distances_m or {}).get(each), metadata={"source": f"{each}.jpg"}))
    write_focal_stack(FocalStack(folder, tuple(slices), metadata=dict(metadata)))


@pytest.fixture(scope="module")
def merged(tmp_path_factory: pytest.TempPathFactory) -> FocalStack:
    """A stack out of order without any distance, merged."""
    folder = tmp_path_factory.mktemp("merged")
    unmerged(folder, (3, 0, 5, 1, 4, 2))
    return merge_scene(folder)[0]


def test_a_stack_without_distances_gets_its_blur_and_says_that_metres_are_guessed(merged: FocalStack) -> None:
    stack = merged
    assert [each.metadata["source"] for each in stack.slices] in ([f"{i}.jpg" for i in range(6)], [f"{i}.jpg" for i in range(5, -1, -1)])
    assert not stack.metres_known and stack.is_metric
    assert "no focus distance is stated" in stack.metadata["metres"]["why"]
    # Nearest and farthest plane of focus as guessed, and the nearest is the nearest.
    near = [each.metadata["source"] for each in stack.slices].index("0.jpg")
    assert stack.focus_distances_m[near] == pytest.approx(1.0) and stack.focus_distances_m[5 - near] == pytest.approx(2.0)
    # Blur is that of the lens the slices were rendered with, though metres are not: 22.5 px from the first focus to the last.
    channels = read_exr(stack.depth_path)[0].channels
    for index, each in enumerate(stack.slices):
        from_depth = stack.coc_px(index, stack.depth_m())
        from_position = each.metadata["blur_position_px"] - channels["blur_position"]
        np.testing.assert_allclose(from_depth, from_position, atol=0.02)
    positions_px = [each.metadata["blur_position_px"] for each in stack.slices]
    assert np.ptp(positions_px) == pytest.approx(GROWTH * np.ptp(DIOPTRES), rel=0.06)


def test_two_stated_distances_give_metres(tmp_path: Path) -> None:
    """Far first, as the distances tell; the other slices follow by their blur."""
    unmerged(tmp_path, (5, 4, 3, 2, 1, 0), {0: 1.0 / DIOPTRES[0], 4: 1.0 / DIOPTRES[4]})
    stack = merge_scene(tmp_path)[0]
    assert stack.metres_known and stack.metadata["metres"]["gauge"]["near_first_from"] == "stated distances"
    dioptres = [1.0 / float(each or np.inf) for each in stack.focus_distances_m]
    np.testing.assert_allclose(dioptres, DIOPTRES[::-1], atol=0.03)
    assert stack.focus_distances_m[5] == 1.0 / DIOPTRES[0], "a stated distance stays as stated"


def test_what_is_known_fixes_the_gauge() -> None:
    """Positions that grow towards the camera, 30 px apart, in a picture of 3600 px."""
    positions_px, size_px = np.array([15.0, 5.0, -15.0]), (3600, 2400)

    def gauged(*distances_m: float | None, **metadata: object) -> tuple[list[float], bool]:
        stack = FocalStack(Path(), tuple(Slice("", each) for each in distances_m), metadata=dict(metadata))
        gauge = gauge_of(stack, positions_px, size_px)
        return gauge.dioptres(positions_px).tolist(), gauge.known

    optics = {"focal_length_mm": 50.0, "f_number": 2.5, "sensor_width_mm": 36.0}
    nothing, one, two = gauged(None, None, None), gauged(2.0, None, None), gauged(0.5, None, 2.0)
    assert nothing == (pytest.approx([1.0, 5.0 / 6.0, 0.5]), False)
    # Stated at 2 m: the farthest is put at twice that.
    assert one == (pytest.approx([0.5, 5.0 / 12.0, 0.25]), False)
    assert two == (pytest.approx([2.0, 1.5, 0.5]), True)
    # 100 px per mm times 50^2 / 2.5 / 1000 mm m: 100 px per dioptre, 0.3 dioptres from the first to the last.
    assert gauged(None, None, None, optics=optics) == (pytest.approx([0.6, 0.5, 0.3]), False)
    assert gauged(None, None, 5.0, optics=optics) == (pytest.approx([0.5, 0.4, 0.2]), True)
    # No lens of 800 mm focuses at 0.6 m: what it states cannot be meant.
    far_off = optics | {"focal_length_mm": 800.0, "f_number": 640.0 * 2.5}
    assert gauged(None, None, None, optics=far_off) == nothing


def test_a_slice_at_infinity_tells_where_the_others_lie_but_not_how_deep() -> None:
    """Six slices 4 px apart, the farthest at infinity: 20 px are half a dioptre, as where nothing is stated."""
    positions_px = np.array([13.0, 9.0, 5.0, 1.0, -3.0, -7.0])
    stack = FocalStack(Path(), tuple(Slice("", each) for each in (None, None, None, None, None, float("inf"))))
    gauge = gauge_of(stack, positions_px, (3600, 2400))
    np.testing.assert_allclose(gauge.dioptres(positions_px)[:5], [0.5, 0.4, 0.3, 0.2, 0.1])
    assert gauge.px_per_dioptre == pytest.approx(40.0) and not gauge.known


@pytest.mark.parametrize(("places", "near_first"), [([0], False), ([3], True), ([3, 2], True), ([0, 3], None), ([], None)])
def test_nothing_lies_beyond_infinity(places: list[int], near_first: bool | None) -> None:
    plane = np.zeros((2, 2), np.float32)
    relative = RelativeFocus(np.array([-6.0, -2.0, 2.0, 6.0]), np.ones(4), plane, plane)
    stack = FocalStack(Path(), tuple(Slice("", float("inf") if index in places else None) for index in range(4)))
    expected = None if near_first is None else Direction(near_first, FROM_DISTANCES, sure=True)
    assert stated_direction(stack, relative) == expected


def test_blur_is_right_in_pixels_beside_a_slice_at_infinity(tmp_path: Path) -> None:
    """What one slice shows of a surface on which another is focused, against the solved positions."""
    unmerged(tmp_path, (0, 1, 2, 3, 4, 5), {5: float("inf")})
    stack = merge_scene(tmp_path)[0]
    positions_px = np.array([each.metadata["blur_position_px"] for each in stack.slices])
    assert stack.focus_distances_m[5] == float("inf") and np.ptp(positions_px) > 20.0
    for index in range(6):
        for other, distance_m in enumerate(stack.focus_distances_m):
            on_other_px = stack.coc_px(index, np.full((1, SIZE[1]), distance_m, np.float32))
            np.testing.assert_allclose(on_other_px, positions_px[index] - positions_px[other], atol=0.05)


def test_merging_anew_says_what_was_told_before_and_takes_nothing_guessed_for_stated(
    merged: FocalStack, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    shutil.copytree(merged.folder, tmp_path, dirs_exist_ok=True)

    def run(*arguments: object) -> str:
        code, told = said(capsys, monkeypatch, "capture", *arguments)
        assert code == 0, told
        return told

    assert run("merge", tmp_path).startswith(f"all of {tmp_path} was merged before and stays as it is (--overwrite merges it again)")
    run("scale", tmp_path, "--nearest", "last", "--distance-at", "100.5,90,0.35")
    run("scale", tmp_path, "--ruler", "70,60,130,140,0.125")
    told = run("merge", tmp_path, "--overwrite")
    assert "stays as it is" not in told
    assert f"capture scale {tmp_path} --distance-at 100.5,90,0.35 --ruler 70,60,130,140,0.125 --nearest last`" in told
    assert "without what was told" not in run("merge", tmp_path, "--overwrite")
    again = read_focal_stack(tmp_path)
    assert again.focus_distances_m == merged.focus_distances_m
    assert [each.metadata["source"] for each in again.slices] == [each.metadata["source"] for each in merged.slices]


def test_discs_of_the_evidence_are_those_that_renderers_draw() -> None:
    """Diameters are kept as numbers and kernels made by subpixels, for speed; they stand for a table and exact coverage."""
    disc = Aperture.disc()
    np.testing.assert_allclose(drawn_diameters_px(np.array([DIAMETERS_PX], np.float32), disc)[0], DRAWN_PX, atol=1e-3)
    for drawn_px in DRAWN_PX[1:]:
        kernel = disc_kernel(drawn_px)
        np.testing.assert_allclose(kernel, disc.rasterize(drawn_px).kernel, atol=0.01 * kernel.max())
