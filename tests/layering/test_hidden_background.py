"""What hides behind edges and how rims are taken apart; the fast searches against plain ones."""

from concurrent.futures import ThreadPoolExecutor

import cv2
import numpy as np
import pytest
from scipy.ndimage import minimum_filter

from mrbokeh.layering._hidden_background_numba import Front, find_rims, nearest_behind, pure_neighbours, snap
from mrbokeh.layering.hidden_background import split_edges
from mrbokeh.layering.highlights import find_highlights
from mrbokeh.layering.padded_layers import PaddedLayer
from mrbokeh.system.resources import CallingThread

SIZE = (72, 96)
Parts = tuple[tuple[np.ndarray, np.ndarray], tuple[np.ndarray, np.ndarray]]


def parted(values: np.ndarray, coc_px: np.ndarray) -> Parts:
    """Front and behind, each as light and circles of confusion of the whole picture."""
    front, behind = split_edges(PaddedLayer(values.copy(), coc_px.astype(np.float32), True), CallingThread())
    shown = np.zeros_like(values), np.zeros(coc_px.shape, np.float32)
    shown[0].reshape(-1, values.shape[2])[behind.places], shown[1].reshape(-1)[behind.places] = behind.values, behind.coc_px
    return (front.values.reshape(values.shape), front.coc_px.reshape(coc_px.shape)), shown


def cluttered(seed: int, size: tuple[int, int] = SIZE) -> tuple[np.ndarray, np.ndarray]:
    """Discs at all depths before rolling ground, some of the depth map blurred as by resizing, and lights."""
    rng = np.random.default_rng(seed)
    values = rng.uniform(0.0, 1.0, (*size, 4)).astype(np.float32)
    coc_px = 5.0 * cv2.GaussianBlur(rng.standard_normal(size).astype(np.float32), (0, 0), 3)
    rows, columns = np.mgrid[: size[0], : size[1]]
    for _ in range(8):
        disc = np.hypot(rows - rng.integers(size[0]), columns - rng.integers(size[1])) < rng.integers(1, 20)
        coc_px[disc], values[disc] = rng.uniform(-30.0, 30.0), values[disc] * np.float32(rng.uniform(0.2, 3.0))
    coc_px[:, : size[1] // 2] = cv2.GaussianBlur(coc_px, (0, 0), 0.7)[:, : size[1] // 2]
    lit = rng.uniform(size=size) < 0.003
    values[lit, :3] *= 300.0
    values[..., 3] = 1.0
    return values, coc_px.astype(np.float32)


def plainly_snapped(coc_px: np.ndarray, lit: np.ndarray) -> np.ndarray:
    """Pixel by pixel: between even surfaces (steps up to 0.5 px) that differ by more than 2 px, at most 2 px away on opposite sides."""
    result = coc_px.copy()
    for y, x in np.ndindex(coc_px.shape):
        if lit[y, x] or not (3 <= y < coc_px.shape[0] - 3 and 3 <= x < coc_px.shape[1] - 3):
            continue
        for dy, dx in ((0, 1), (1, 0), (1, 1), (1, -1)):
            line = {k: coc_px[y + k * dy, x + k * dx] for k in range(-3, 4)}
            if abs(line[0] - line[1]) <= 0.5 and abs(line[0] - line[-1]) <= 0.5:
                continue
            for before in (1, 2):
                for after in (1, 2):
                    a, b = line[-before], line[after]
                    even = abs(a - line[-before - 1]) <= 0.5 and abs(b - line[after + 1]) <= 0.5
                    between = min(a, b) < line[0] < max(a, b) and min(abs(line[0] - a), abs(line[0] - b)) > 0.5
                    if even and between and abs(a - b) > 2.0:
                        result[y, x] = a if abs(line[0] - a) < abs(line[0] - b) else b
    return result


@pytest.mark.parametrize("seed", range(4))
def test_edges_of_the_depth_map_against_plain_definitions(seed: int) -> None:
    """Snapped pixels, and rims: something more than 1 px nearer among the 8 neighbours."""
    values, coc_px = cluttered(seed, (36, 44))
    lit = find_highlights(values)
    snapped, rim = np.empty_like(coc_px), np.empty(coc_px.shape, np.bool_)
    snap(snapped, coc_px, lit, 1.0, 0, len(coc_px))
    np.testing.assert_array_equal(snapped, plainly_snapped(coc_px, lit))
    assert (snapped != coc_px).sum() > 5
    find_rims(rim, snapped, 1.0, 0, len(coc_px))
    np.testing.assert_array_equal(rim, snapped - minimum_filter(snapped, 3, mode="nearest") > 1.0)


def test_behind_objects_at_one_depth_the_nearest_pixel_of_the_ground_is_the_seed() -> None:
    """Brute force over all pure pixels beside the rims: of a difference of 20 px the lens sees 10 and a rim's width. A straight line to
    the nearest of the ground stays on the object, so the brush fire finds it, up to what a path of single steps may miss: a pixel."""
    rows, columns = np.mgrid[:50, :70]
    discs = [(15, 20, 12), (22, 33, 6), (38, 50, 14), (40, 10, 3)]
    near = np.any([np.hypot(rows - y, columns - x) < radius for y, x, radius in discs], axis=0)
    coc_px = np.where(near, -20.0, 0.0).astype(np.float32)
    rim = coc_px - minimum_filter(coc_px, 3, mode="nearest") > 1.0
    rims = np.flatnonzero(rim).astype(np.int32)
    pure = pure_neighbours(rims, coc_px, ~rim, 1.0, 3)
    front = Front.over(coc_px.size)
    nearest_behind(front, coc_px, rims, pure, 1.0)
    sources, places = np.unique(pure[pure >= 0]), np.flatnonzero(near)
    least_px = np.hypot(sources // 70 - places[:, None] // 70, sources % 70 - places[:, None] % 70).min(axis=1)
    found = front.seeds[places] > 0
    np.testing.assert_array_equal(found, least_px <= 13.5)
    assert 0 < (~found).sum() < found.sum() and not front.seeds[np.flatnonzero(~near)].any()
    at = front.seeds[places] - 1
    distance_px = np.hypot(at // 70 - places // 70, at % 70 - places % 70)[found]
    assert np.isin(at[found], sources).all()
    assert (distance_px <= least_px[found] + 1.0).all() and (distance_px == least_px[found]).mean() > 0.95


@pytest.mark.parametrize("seed", range(2))
def test_parting_does_not_depend_on_threads(seed: int, monkeypatch: pytest.MonkeyPatch) -> None:
    values, coc_px = cluttered(seed)
    alone = parted(values, coc_px)
    monkeypatch.setattr("mrbokeh.system.resources.cores", lambda: 3)
    with ThreadPoolExecutor(3) as pool:
        front, behind = split_edges(PaddedLayer(values.copy(), coc_px.copy(), True), pool)
    np.testing.assert_array_equal(front.values, alone[0][0].reshape(-1, 4))
    np.testing.assert_array_equal(front.coc_px, alone[0][1].reshape(-1))
    np.testing.assert_array_equal(behind.values, alone[1][0].reshape(-1, 4)[behind.places])
    assert len(behind.places) == (alone[1][0][..., 3] > 0).sum() > 200


def test_an_even_surface_hides_nothing_and_stays_as_it_is() -> None:
    """One depth all over has no edge, whatever is painted on it, lights too."""
    values, coc_px = cluttered(1)[0], np.full(SIZE, 3.0, np.float32)
    (front, front_coc_px), (behind, _) = parted(values, coc_px)
    np.testing.assert_array_equal(front, values)
    np.testing.assert_array_equal(front_coc_px, coc_px)
    assert not behind.any()


def test_antialiased_depth_leaves_nothing_in_the_air_and_parting_loses_no_light() -> None:
    """A disc at another depth, its depth map resized as pictures are, so that its rim lies at every depth between: the rim's
    pixels take one side or the other, and a steep but even slope stays as it is."""
    rows, columns = np.mgrid[: 4 * SIZE[0], : 4 * SIZE[1]]
    fine = np.where(np.hypot(rows - 144, columns - 192) < 80, -12.0, 9.0).astype(np.float32)
    coc_px = cv2.resize(fine, SIZE[::-1], interpolation=cv2.INTER_AREA)
    floating = (coc_px > -11.9) & (coc_px < 8.9)
    (_, front_coc_px), _ = parted(np.ones((*SIZE, 4), np.float32), coc_px)
    left = (front_coc_px > -11.9) & (front_coc_px < 8.9)
    assert floating.sum() > 100 and left.sum() <= 0.05 * floating.sum()
    slope = np.broadcast_to(np.linspace(-60.0, 60.0, SIZE[1], dtype=np.float32), SIZE).copy()
    snapped = np.empty_like(slope)
    snap(snapped, slope, np.zeros(SIZE, bool), 1.0, 0, len(slope))
    np.testing.assert_array_equal(snapped, slope)
    rng = np.random.default_rng(2)
    values = np.concatenate([rng.uniform(0.0, 1.0, (*SIZE, 3)), np.ones((*SIZE, 1))], axis=2).astype(np.float32)
    coc_px = np.zeros(SIZE, np.float32)
    coc_px[20:50, 30:60] = -15.0
    (front, front_coc_px), (behind, _) = parted(values, coc_px)
    shown = front + (1.0 - front[..., 3:]) * behind
    assert shown[..., 3].min() == 1.0
    np.testing.assert_allclose(shown, values, atol=1e-6)
    np.testing.assert_array_equal(front_coc_px[front[..., 3] == 1.0], coc_px[front[..., 3] == 1.0])


def test_background_is_filled_no_farther_than_the_lens_sees_and_not_from_lamps() -> None:
    """Half of a difference of 16 px in the circles of confusion, and a rim of 3.5 px for the pixels that are mixed."""
    values = np.ones((*SIZE, 4), np.float32) * np.float32([0.1, 0.1, 0.1, 1.0])
    coc_px = np.zeros(SIZE, np.float32)
    coc_px[:, :48] = -16.0
    values[36, 50, :3] = 1000.0
    assert find_highlights(values).sum() == 1
    _, (behind, behind_coc_px) = parted(values, coc_px)
    filled = behind[36, :, 3] > 0
    assert filled[40:48].all() and not filled[:36].any()
    np.testing.assert_allclose(behind_coc_px[36, 40:48], 0.0)
    assert behind[..., :3].max() < 0.11
