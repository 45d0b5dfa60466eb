"""Which runs a table needs: every row on every data set with every seed, each with its settings and its folder."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from mrbokeh.system.errors import InputError
from training.ablation.rows import Row
from training.presets import PRESETS
from training.settings import TrainSettings
from training.slice_rows import slice_size_px
from training.stacks import stack_name
from training.training_data import TrainingData, training_data

PAPER_WIDTH_PX = 1920
SPLIT_SEED = 0
TEST_FRACTION = 0.2


@dataclass(frozen=True)
class Ablation:
    """What all runs share. minutes or epochs: the budget of each. tile_px, overlap_px: of rows with tiles, None scales those of the
    settings, which belong to pictures of 1920 px, with the width of the pictures, so that there are as many tiles as in the paper.
    base: what the rows of the published form start from."""

    minutes: float | None = 10.0
    epochs: int | None = None
    seeds: int = 1
    tile_px: int | None = None
    overlap_px: int | None = None
    device: str = "auto"
    threads: int = 0
    base: TrainSettings | None = None


@dataclass(frozen=True)
class DataSet:
    """A data set or scene folder by the name that tables show; held_out: names of the stacks that no run trains on."""

    name: str
    folder: Path
    data: TrainingData
    held_out: tuple[str, ...]
    width_px: int


@dataclass(frozen=True)
class PlannedRun:
    row: Row
    seed: int
    data_set: DataSet
    settings: TrainSettings
    folder: Path


def read_data_sets(folders: Sequence[Path]) -> list[DataSet]:
    """Raises InputError where two have one name, or where nothing is held out."""
    sets = [_data_set(folder) for folder in folders]
    names = [each.name for each in sets]
    if len(set(names)) < len(names):
        raise InputError(f"tables name data sets by their folders, got {', '.join(names)}: rename one")
    return sets


def planned_runs(rows: Sequence[Row], data_sets: Sequence[DataSet], out: Path, ablation: Ablation) -> list[PlannedRun]:
    """Seed by seed and row by row, so that an unfinished table has as many whole rounds as possible."""
    return [
        PlannedRun(row, seed, each, settings_of(row, each.width_px, seed, ablation), run_folder(out, each.name, row, seed))
        for seed in range(ablation.seeds)
        for row in rows
        for each in data_sets
    ]


def run_folder(out: Path, set_name: str, row: Row, seed: int) -> Path:
    return out / "runs" / set_name / row.name / f"seed_{seed}"


def settings_of(row: Row, width_px: int, seed: int, ablation: Ablation) -> TrainSettings:
    """The settings of a row for pictures of that width."""
    base = ablation.base if ablation.base is not None and row.start == "paper" else PRESETS[row.start]()
    tiles = scaled_tiles(base, width_px, ablation) if base.network.tile_px else {}
    network = replace(base.network, **tiles | dict(row.network))
    budget: dict[str, Any] = {"minutes": ablation.minutes, "epochs": ablation.epochs, "patience": 0}
    place: dict[str, Any] = {"device": ablation.device, "threads": ablation.threads, "seed": seed}
    return replace(base, network=network, **budget | place | dict(row.training))


def scaled_tiles(base: TrainSettings, width_px: int, ablation: Ablation) -> dict[str, Any]:
    """tile_px and overlap_px: those asked for, else in proportion to the width of the picture."""
    scale = width_px / PAPER_WIDTH_PX
    tile_px = ablation.tile_px if ablation.tile_px is not None else max(2, round(base.network.tile_px * scale))
    overlap_px = ablation.overlap_px if ablation.overlap_px is not None else round(base.network.overlap_px * scale)
    return {"tile_px": tile_px, "overlap_px": overlap_px}


def _data_set(folder: Path) -> DataSet:
    """The split is the manifest's, or for scene folders drawn once for all rows and seeds."""
    data = training_data([folder])
    split = data.split((), TEST_FRACTION, SPLIT_SEED)
    if not split.test or split.held_out_slices:
        raise InputError(f"{folder} has {len(data.stacks)} stack and none to test on: give data with at least two viewpoints")
    names = tuple(stack_name(stack) for stack in split.test)
    return DataSet(folder.resolve().name, folder, data, names, slice_size_px(data.stacks[0], 0)[1])
