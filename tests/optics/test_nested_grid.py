"""The nested grid: the paper's example, a cover without gaps, and a forward map that agrees with looking through all boxes."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mrbokeh.optics.psf_grid import NestedGrid, triangular, triangular_root
from mrbokeh.system.errors import InputError

SHAPES = [(1,), (7,), (9, 9), (5, 12), (13, 4), (1, 6), (8, 9, 10)]


def searched(grid: NestedGrid, point: np.ndarray) -> int:
    """The slow twin of `index_of`: the one box that holds the point."""
    inside = ((grid.boxes[..., 0] <= point) & ((point < grid.boxes[..., 1]) | (grid.boxes[..., 1] == 1.0))).all(axis=1)
    (found,) = np.flatnonzero(inside)
    return int(found)


def test_the_example_of_the_paper() -> None:
    """Leimkuehler 2018, Section 5.2 and Fig. 5: 9 x 9 has 28 cells in four levels that begin at 0, 1, 3 and 6; a regular grid 81."""
    grid = NestedGrid((9, 9))
    assert len(grid) == 28 and len(NestedGrid((9, 9), nested=False)) == 81
    edges = np.round(9 * grid.boxes).astype(int)
    diagonal = [edge for edge in edges if edge[0, 0] == edge[1, 0]]
    assert [tuple(edge[0]) for edge in diagonal] == [(0, 1), (1, 3), (3, 6), (6, 9)], "the last is cut off: an edge of 4 would end at 10"
    # Table 1: 400 samples for two coordinates. Storage grows as n^1.5 instead of n^2: four times the steps, eight times the cells.
    # Levels end at about sqrt(2 n); level l has about 2 (n - l^2 / 2) / l cells, which sums to n log n: well below n^1.5.
    assert 380 <= len(NestedGrid((75, 75))) <= 420
    assert len(NestedGrid((600, 600))) < 8 * len(NestedGrid((150, 150)))


@pytest.mark.parametrize("counts", SHAPES)
@pytest.mark.parametrize("nested", [True, False])
def test_cells_cover_the_cube_once(counts: tuple[int, ...], nested: bool) -> None:
    grid = NestedGrid(counts, nested)
    sizes = grid.boxes[..., 1] - grid.boxes[..., 0]
    assert len(grid) == len(grid.boxes) and (sizes > 0).all()
    assert sizes.prod(axis=1).sum() == pytest.approx(1.0, abs=1e-12)
    np.testing.assert_array_equal(grid.index_of(grid.boxes.mean(axis=2)), np.arange(len(grid)))


@given(st.sampled_from(SHAPES), st.booleans(), st.integers(0, 10**6))
@settings(max_examples=60, deadline=None)
def test_the_forward_map_finds_the_box(counts: tuple[int, ...], nested: bool, seed: int) -> None:
    grid = NestedGrid(counts, nested)
    point = np.random.default_rng(seed).random(len(counts))
    assert int(grid.index_of(point)) == searched(grid, point)


@pytest.mark.parametrize("counts", SHAPES)
def test_the_low_ends_of_boxes_belong_to_them(counts: tuple[int, ...]) -> None:
    """A grain above their low corner, where the triangular root jumps."""
    grid = NestedGrid(counts)
    np.testing.assert_array_equal(grid.index_of(grid.boxes[..., 0] + 1e-12), np.arange(len(grid)))


def test_cells_grow_linearly_and_the_triangular_root_is_exact_at_its_jumps() -> None:
    grid = NestedGrid((36, 36))
    steps = np.round(36 * grid.boxes).astype(int)
    whole = steps[(steps[..., 1] < 36).all(axis=1)]
    level = triangular_root(whole[..., 0].min(axis=1).astype(float))
    np.testing.assert_array_equal(whole[..., 1] - whole[..., 0], np.stack([level + 1] * 2, axis=1))
    levels = np.arange(3000)
    starts = np.asarray(triangular(levels), np.float64)
    np.testing.assert_array_equal(triangular_root(starts), levels)
    np.testing.assert_array_equal(triangular_root(np.nextafter(starts[1:], 0.0)), levels[:-1])


def test_points_outside_go_to_the_nearest_cell_and_a_grid_needs_steps() -> None:
    grid = NestedGrid((9, 9))
    assert grid.index_of(np.array([-3.0, 5.0])) == grid.index_of(np.array([0.0, 1.0]))
    places = np.random.default_rng(0).random((4, 5, 2))
    np.testing.assert_array_equal(grid.index_of(places)[2, 3], grid.index_of(places[2, 3]))
    with pytest.raises(InputError, match="at least one step"):
        NestedGrid((4, 0))
