"""Grids in proportion: they cover the square once, steps are what their docstring says, and the default bank gains by them."""

import numpy as np
import pytest

from mrbokeh.figures.psf_bank_drawing import draw_bank, sampled_cells
from mrbokeh.optics.psf_bank import Axis, PsfBank, grid_over
from mrbokeh.optics.psf_bank_file import read_bank, write_bank
from mrbokeh.optics.psf_grid import ProportionalGrid
from mrbokeh.psf_models.build import PAPER_COUNTS, Combined, bank_head
from mrbokeh.system.errors import InputError
from tests.bench.bench_combined_bank import overlaps

GRIDS = [
    ProportionalGrid((40, 18), (256.0, 256.0), 5.0),
    ProportionalGrid((7, 3), (20.0, 300.0), 2.0),
    ProportionalGrid((1, 1), (9.0, 9.0), 1.0),
]


@pytest.mark.parametrize("grid", GRIDS)
def test_boxes_cover_the_square_once(grid: ProportionalGrid) -> None:
    """Areas sum to 1, and the cell that a point is found in is the only one whose box holds it."""
    low, high = grid.boxes[:, :, 0], grid.boxes[:, :, 1]
    assert (high > low).all() and np.prod(high - low, axis=1).sum() == pytest.approx(1.0, rel=1e-12)
    points = np.random.default_rng(0).random((2000, 2))
    holds = ((low <= points[:, None]) & (points[:, None] < high)).all(axis=2)
    np.testing.assert_array_equal(holds.sum(axis=1), 1)
    np.testing.assert_array_equal(grid.index_of(points), holds.argmax(axis=1))


@pytest.mark.parametrize("grid", GRIDS)
def test_middles_corners_and_what_lies_beyond(grid: ProportionalGrid) -> None:
    np.testing.assert_array_equal(grid.index_of(grid.boxes.mean(axis=2)), np.arange(len(grid)))
    corners = grid.index_of(np.array([[0.0, 0.0], [1.0, 1.0], [0.0, 1.0], [-3.0, 7.0]]))
    assert corners[0] == 0 and corners[1] == len(grid) - 1 and corners[2] == corners[3]
    assert grid.index_of(np.array([0.0, 1.0])) == corners[2], "one place by itself"


def test_steps_are_in_proportion() -> None:
    """A row is as high as every other in log(d + knee), and a step in it as wide in log(m + d + knee), but for whole numbers of steps."""
    grid = GRIDS[0]
    px = grid.boxes * 256.0
    rows = np.diff(np.log(px[:, 0] + 5.0), axis=1)
    np.testing.assert_allclose(rows, np.log1p(256.0 / 5.0) / 40.0, rtol=1e-9)
    widths = np.diff(np.log(px[:, 1] + px[:, 0].mean(axis=1)[:, None] + 5.0), axis=1)[:, 0]
    many = np.repeat(grid.steps, grid.steps) >= 4
    np.testing.assert_allclose(widths[many], widths[0], rtol=0.13)  # 4 steps for what would be 3.5 to 4.5
    assert grid.steps[0] == 18 and (np.diff(grid.steps) <= 0).all() and grid.steps[-1] <= 4


@pytest.mark.parametrize(
    ("cells", "highs_px"), [(400, (256.0, 256.0)), (400, (64.0, 64.0)), (100, (512.0, 20.0)), (2000, (256.0, 256.0)), (1, (9.0, 9.0))]
)
def test_as_many_cells_as_asked_for_and_no_more(cells: int, highs_px: tuple[float, float]) -> None:
    grid = ProportionalGrid.of_cells(cells, highs_px, 5.0, 2.0)
    assert 0.95 * cells <= len(grid) <= cells


@pytest.mark.slow
def test_the_default_bank_is_nearer_to_exact_kernels_than_the_papers() -> None:
    """At 60 places each, even over the range and over octaves from half a pixel on: a third less light lies elsewhere, with no more cells.

    tests/bench/bench_combined_bank.py measures it at 1,000 places. The range is half of the default's, so that it takes seconds.
    """
    rng = np.random.default_rng(1)
    paper, ours = Combined(128.0, 128.0, PAPER_COUNTS), Combined(128.0, 128.0, cells=392)
    assert len(bank_head(ours, 0, 0).grid) <= len(bank_head(paper, 0, 0).grid) == 392
    for places in (128.0 * rng.random((60, 2)), 0.5 * 256.0 ** rng.random((60, 2))):
        elsewhere = [1.0 - overlaps(model, places) for model in (paper, ours)]
        assert elsewhere[1].mean() < 0.75 * elsewhere[0].mean()
        assert np.percentile(elsewhere[1], 95) < 0.7 * np.percentile(elsewhere[0], 95)


def test_a_bank_in_proportion_comes_back_from_its_folder(tmp_path) -> None:
    axes = (Axis("diameter_px", 0.0, 20.0), Axis("motion_px", 0.0, 300.0))
    cells = len(ProportionalGrid((7, 3), (20.0, 300.0), 2.0))
    kernels = tuple(np.full((1, 1, 1), 1.0, np.float32) for _ in range(cells))
    write_bank(tmp_path / "bank", PsfBank("m", axes, (7, 3), kernels, "motion", nested=False, knee_px=2.0))
    again = read_bank(tmp_path / "bank")
    assert again.grid == ProportionalGrid((7, 3), (20.0, 300.0), 2.0)
    np.testing.assert_array_equal(again.nearest(again.centres), np.arange(cells))
    np.testing.assert_array_equal(again.nearest(again.centres * [-1.0, 1.0]), np.arange(cells), err_msg="both sides of the focus")


def test_its_sheet_shows_small_kernels_too_and_odd_grids_are_refused() -> None:
    """Six by six of them, the smallest within the first tenth of both ranges, the largest in the last third."""
    model = Combined(64.0, 64.0, cells=60)
    head = bank_head(model, 0, 0)
    kernels = (np.ones((1, 1, 1), np.float32),) * len(head.grid)
    bank = PsfBank("m", head.axes, head.counts, kernels, nested=False, knee_px=head.knee_px)
    cells = sampled_cells(bank)
    assert len(cells) == 36 and (bank.centres[cells[0]] < 6.4).all() and (bank.centres[cells[-1]] > 42.0).all()
    assert "each of which shares" in " ".join(axes.get_title() for axes in draw_bank(bank).axes)
    for counts, highs_px, knee_px in (
        ((0, 3), (9.0, 9.0), 1.0),
        ((3,), (9.0,), 1.0),
        ((3, 3), (9.0, -9.0), 1.0),
        ((3, 3), (9.0, 9.0), 0.0),
    ):
        with pytest.raises(InputError, match="proportional grid needs"):
            ProportionalGrid(counts, highs_px, knee_px)
    with pytest.raises(InputError, match="at least one cell"):
        ProportionalGrid.of_cells(0, (9.0, 9.0), 1.0, 2.0)
    with pytest.raises(InputError, match="linear axes"):
        grid_over((Axis("diameter_px", 0.0, 9.0, 2.0), Axis("motion_px", 0.0, 9.0)), (3, 3), False, 1.0)
