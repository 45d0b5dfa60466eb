"""Tables of trained variants on tiny stacks: that the machinery is right, not that the networks are good."""

import csv
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from mrbokeh.images.image_metrics import psnr
from tests.support.card_stack import SIZE, make_card_scene
from tests.support.command_line import mrbokeh, printed_by
from tests.support.refusals import refused
from training.ablation.plan import (
    PAPER_TABLE_3,
    PUBLISHED,
    TABLES,
    Ablation,
    Row,
    paper_numbers,
    planned_runs,
    read_data_sets,
    rows_of,
    settings_of,
)
from training.ablation.tables import RunResult, lines_of, markdown_of, read_result, summary, table_cells
from training.cli import app
from training.data.dataset import PairSet
from training.data.pairs import WHERE_TRUTH_IS_KNOWN
from training.data.training_data import training_data
from training.evaluation.methods import blur_of
from training.fitting import train
from training.fitting.run_folder import load_run
from training.fitting.settings import TrainSettings, write_settings
from training.networks.network import TileGrid

BUDGET = Ablation(minutes=None, epochs=1, threads=1)
TILES = ("--tile-px", "32", "--overlap-px", "8")
ALL = rows_of(("1", "3", "improvements"))


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return make_card_scene(tmp_path_factory.mktemp("ablation") / "heart_scene")


@pytest.fixture(scope="module")
def small_base(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The published form with one block, which is quick, in the range of the picture without its lights."""
    folder = tmp_path_factory.mktemp("base")
    plain = TrainSettings(epochs=1, learning_rate=5e-3, radiance_scale=1.2, saturation=1.0, validate_every_s=0.0, sheets=False)
    write_settings(folder, replace(plain, network=replace(plain.network, blocks=1)))
    return folder / "settings.json"


def ablate(*arguments: object) -> str:
    return printed_by(app, "ablate", *arguments, "--threads", "1")


@pytest.fixture(scope="module")
def done(scene: Path, small_base: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("done")
    ablate(scene, "--out", out, "--table", "1", "--rows", "no_tiling,published", "--epochs", 1, "--settings", small_base, *TILES)
    return out


def test_rows_are_those_of_the_paper() -> None:
    """Table 1 in its order, with its PSNR; Table 3's heart and its Nikon D3300 with the 28 mm lens."""
    decibels = {"published": 42.0, "3x3": 36.9, "no_tiling": 35.3, "no_overlap": 40.2, "loss_per_tile": 38.1}
    assert [(row.name, row.paper and row.paper.psnr_db) for row in TABLES["1"]] == list(decibels.items())
    heart = {name: each.psnr_db for name, each in PAPER_TABLE_3["heart"].items()}
    assert heart == {"published": 42.1, "neural_camera": 26.7, "deepfocus": 29.4}
    assert PAPER_TABLE_3["28mm"]["published"].lpips == 0.133
    assert paper_numbers(PUBLISHED, "3", ("ring",)) == PAPER_TABLE_3["circle"]["published"], "our name for it"
    assert paper_numbers(PUBLISHED, "3", ("heart", "ring")) is None is paper_numbers(PUBLISHED, "3", ("attic",))
    assert all(table[0] is PUBLISHED for table in TABLES.values())
    assert len({row.name for row in ALL}) == len(ALL)


@pytest.mark.parametrize("row", ALL, ids=[row.name for row in ALL])
def test_a_row_differs_from_the_published_network_in_what_it_says(row: Row) -> None:
    """All settings are valid, and rows that start from the paper change nothing else."""
    plain, mine = settings_of(PUBLISHED, 480, 0, BUDGET), settings_of(row, 480, 0, BUDGET)
    assert (mine.epochs, mine.minutes, mine.patience, mine.seed) == (1, None, 0, 0)
    if row.start == "paper":
        differs = {name for name, value in vars(mine).items() if value != getattr(plain, name) and name != "network"}
        network = {name for name, value in vars(mine.network).items() if value != getattr(plain.network, name)}
        assert differs <= set(row.training) and network <= set(row.network), "what a row says may be what the base has too"
        assert all(getattr(mine, name) == value for name, value in row.training.items())
        assert all(getattr(mine.network, name) == value for name, value in row.network.items())


def test_tiles_and_splits_are_one_for_all_rows(scene: Path, tmp_path: Path) -> None:
    """200 px with 60 px overlap belong to 1920 px, where they make 14 by 8 tiles: as many at a quarter of it, of 50 px with 15."""
    whole, quarter = (settings_of(PUBLISHED, width, 0, BUDGET).network for width in (1920, 480))
    assert (whole.tile_px, whole.overlap_px, quarter.tile_px, quarter.overlap_px) == (200, 60, 50, 15)
    assert len(TileGrid(1080, 1920, 200, 60)) == len(TileGrid(270, 480, 50, 15)) == 14 * 8
    chosen = settings_of(PUBLISHED, 480, 0, replace(BUDGET, tile_px=32, overlap_px=8)).network
    assert (chosen.tile_px, chosen.overlap_px) == (32, 8)
    no_overlap = settings_of(TABLES["1"][3], 480, 0, BUDGET).network
    assert (no_overlap.tile_px, no_overlap.overlap_px) == (50, 0)
    assert settings_of(TABLES["1"][2], 480, 0, BUDGET).network.tile_px == 0
    sets = read_data_sets([scene])
    assert sets[0].width_px == SIZE[1] and len(sets[0].held_out) == 1
    planned = planned_runs(list(TABLES["1"][:2]), sets, tmp_path, replace(BUDGET, seeds=2))
    assert [(each.row.name, each.seed, each.settings.seed) for each in planned] == [(n, s, s) for s in (0, 1) for n in ("published", "3x3")]
    assert {each.data_set.held_out for each in planned} == {sets[0].held_out}
    refused("at least two viewpoints", read_data_sets, [scene / "view_0"])
    refused("rename one", read_data_sets, [scene, scene])


@pytest.mark.slow
def test_the_numbers_of_the_table_are_those_of_the_networks(scene: Path, done: Path) -> None:
    """In the order of the paper's table, computed again from the networks on the stack that was held out."""
    with (done / "table_1.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert [row["row"] for row in rows] == ["published", "no_tiling"]
    decibels = []
    for row in rows:
        run = done / "runs" / "heart_scene" / row["row"] / "seed_0"
        network, settings, facts = load_run(run)
        pairs = PairSet([each for each in training_data([scene]).stacks if each.folder.name in facts.held_out[0]], WHERE_TRUTH_IS_KNOWN)
        blur = blur_of(run)[0]
        decibels.append(float(np.mean([psnr(blur(pairs[index]), pairs[index].target) for index in range(len(pairs))])))
        assert float(row["psnr_db"]) == pytest.approx(decibels[-1], abs=1e-4)
        assert float(row["parameters"]) == sum(each.numel() for each in network.parameters())
        assert row["commit"] == (facts.commit or "unknown") and float(row["slices"]) == len(pairs) == 3
        assert settings.network.tile_px == (32 if row["row"] == "published" else 0)
    assert abs(decibels[0] - decibels[1]) > 1e-3
    assert float(rows[0]["gap_db"]) == 0.0 and float(rows[1]["gap_db"]) == pytest.approx(decibels[1] - decibels[0], abs=1e-4)
    assert float(rows[1]["paper_gap_db"]) == pytest.approx(35.3 - 42.0)


def test_pages_hold_tables_and_finished_runs_are_not_trained_again(
    done: Path, scene: Path, small_base: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    text, page = (done / "results.md").read_text(), (done / "results.html").read_text()
    table = (done / "table_1.md").read_text()
    assert "| Neural Bokeh as published | heart_scene |" in table and table in text and "no weights are shipped" in text
    assert text.count("mrbokeh train fit") == 2 and "(table_1.png)" in text
    assert "<h2>Variants of the design" in page and "data:image/png;base64" in page and "no tiling" in page and "train fit" in page

    def no_training(*_: object) -> None:
        raise AssertionError("trained again")

    before = (done / "table_1.csv").read_bytes()
    monkeypatch.setattr(train, "fit", no_training)
    common = ("--out", done, "--table", "1", "--rows", "no_tiling,published", "--settings", small_base, *TILES)
    ablate(scene, *common, "--epochs", 1)
    assert (done / "table_1.csv").read_bytes() == before
    refused("other settings \\(epochs\\)", ablate, scene, *common, "--epochs", 2)


@pytest.mark.slow
def test_a_stopped_table_goes_on(scene: Path, small_base: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Stopped in the second row: the first is kept and has its table; the same command trains the second alone."""
    fit, trained = train.fit, list[str]()

    def counting(stop_at: int) -> Callable[..., object]:
        def counted(data: object, folder: Path, *rest: object, **named: object) -> object:
            trained.append(folder.parent.name)
            if len(trained) == stop_at:
                raise KeyboardInterrupt
            return fit(data, folder, *rest, **named)  # type: ignore[arg-type]

        return counted

    arguments = [str(scene), "--out", str(tmp_path), "--table", "1", "--rows", "published,no_overlap", "--epochs", "1", *TILES]
    arguments += ["--settings", str(small_base), "--threads", "1"]
    monkeypatch.setattr(train, "fit", counting(stop_at=2))
    assert "goes on" in mrbokeh("train", "ablate", *arguments).stderr
    assert (tmp_path / "table_1.csv").read_text().count("\n") == 2
    monkeypatch.setattr(train, "fit", counting(stop_at=0))
    ablate(*arguments[:-2])
    assert trained == ["published", "no_overlap", "no_overlap"]
    assert (tmp_path / "table_1.csv").read_text().count("\n") == 3


def test_a_dry_run_trains_nothing(scene: Path, done: Path, small_base: Path, tmp_path: Path) -> None:
    """Two rows of 10 minutes with two seeds are 40 minutes; rows say what they change; what is finished takes no time."""
    output = ablate(scene, "--out", tmp_path / "out", "--rows", "3x3,signed_coc", "--seeds", 2, "--dry-run")
    assert output.count("10.0 min") == 4 and "4 runs, about 40 min" in output
    assert "network.kernels=3x3" in output and "network.signed_coc=True" in output and not (tmp_path / "out").exists()
    settings = ("--table", "1", "--epochs", 1, "--settings", small_base, *TILES)
    again = ablate(scene, "--out", done, "--rows", "published,3x3", *settings, "--dry-run")
    assert "2 runs, about" in again and again.count("finished") == 1
    refused("rows among published", ablate, scene, "--out", tmp_path / "out", "--rows", "4x4")
    refused("minutes or in epochs", ablate, scene, "--out", tmp_path / "out", "--minutes", 1, "--epochs", 1)


@pytest.mark.slow
def test_every_row_trains_and_is_measured(scene: Path, small_base: Path, tmp_path: Path) -> None:
    ablate(scene, "--out", tmp_path, "--epochs", 1, "--settings", small_base, *TILES)
    for row in ALL:
        result = read_result(tmp_path / "runs" / "heart_scene" / row.name / "seed_0")
        assert result is not None and result.slices == 3 and np.isfinite(result.measures["psnr_db"])
    assert [(tmp_path / f"{name}.csv").read_text().count("\n") for name in ("table_1", "table_3", "improvements")] == [6, 5, 10]


def made(row: str, data_set: str, seed: int, psnr_db: float) -> RunResult:
    measures = dict.fromkeys(("ssim", "lpips", "edge_psnr_db", "energy_ratio", "leak", "highlight_error", "flicker", "seconds"), 0.5)
    return RunResult(data_set, row, seed, 15, {"psnr_db": psnr_db} | measures, 100, 60.0, 10, "abc", "a machine")


def test_means_are_over_sets_then_seeds_with_the_papers_numbers() -> None:
    """Seeds give (30 + 34) / 2 = 32 and (31 + 37) / 2 = 34: mean 33, standard deviation sqrt(2). The third seed lacks a set."""
    values = {("heart", 0): 30.0, ("round", 0): 34.0, ("heart", 1): 31.0, ("round", 1): 37.0, ("heart", 2): 99.0}
    results = [made("published", name, seed, value) for (name, seed), value in values.items()]
    found = summary(PUBLISHED, results, ["heart", "round"])
    assert (found.seeds, found.slices, found.means["psnr_db"]) == (2, 30, 33.0)
    assert found.spreads["psnr_db"] == pytest.approx(np.sqrt(2.0))
    assert summary(PUBLISHED, results, ["bladed"]) is None
    # Gaps are to the first row of the same set: 30 - 40 in "my_heart", where the paper has 26.7 - 42.1; it has no square bokeh.
    values = (("published", 40.0), ("neural_camera", 30.0))
    results = [made(row, name, 0, value) for name in ("my_heart", "square") for row, value in values]
    lines = lines_of("3", results, ["my_heart", "square"])
    expected = [((name,), *row) for name in ("my_heart", "square") for row in (("published", 0.0), ("neural_camera", -10.0))]
    assert [(line.sets, line.summary.row.name, line.gap_db) for line in lines] == expected
    assert lines[1].paper_gap_db == pytest.approx(26.7 - 42.1) and np.isnan(lines[3].paper_gap_db)
    headings, rows = table_cells(lines)
    assert all(len(row) == len(headings) for row in rows)
    assert "| my_heart | PSNR dB | 40.00 (42.1) | 30.00 (26.7) |" in markdown_of("3", lines)
    lines = lines_of("1", [made("3x3", "heart", 0, 30.0)], ["heart"])
    assert [line.summary.row.name for line in lines] == ["3x3"] and np.isnan(lines[0].gap_db)
    assert read_result(Path("nowhere")) is None
