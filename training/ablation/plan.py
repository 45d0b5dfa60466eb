"""The rows of the tables as data, and the runs that a table needs: every row on every data set with every seed.

A row states what it changes and the numbers that the paper has for it (Mandl et al. 2024, Tables 1 and 3). Every row changes the first
row of its table, the network as published; rows of the same name are one run, whatever table they are in.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal

from mrbokeh.system.errors import InputError
from training.data.pairs import slice_size_px
from training.data.stacks import stack_name
from training.data.training_data import TrainingData, focal_stacks, training_data
from training.fitting.settings import PRESETS, TrainSettings

TableName = Literal["1", "3", "improvements"]
_NO_TILES = {"tile_px": 0, "overlap_px": 0}
TITLES: dict[TableName, str] = {
    "1": "Variants of the design (the paper's Table 1)",
    "3": "Against other networks, by data set (the paper's Table 3)",
    "improvements": "Improvements, one at a time",
}
FILE_NAMES: dict[TableName, str] = {"1": "table_1", "3": "table_3", "improvements": "improvements"}
_OUR_NAMES = {"ring": "circle"}
"""Shapes of datasets_scripts.bokeh_stacks that are called otherwise in the paper."""
PAPER_WIDTH_PX = 1920
SPLIT_SEED = 0
TEST_FRACTION = 0.2


@dataclass(frozen=True)
class PaperNumbers:
    psnr_db: float
    ssim: float
    lpips: float


@dataclass(frozen=True)
class Row:
    """One row. name: of its runs. start: the preset that it changes. network, training: settings that differ from it.

    paper: of Table 1. note: what one must know to read the number.
    """

    name: str
    title: str
    start: Literal["paper", "demo"] = "paper"
    network: Mapping[str, Any] = field(default_factory=dict)
    training: Mapping[str, Any] = field(default_factory=dict)
    paper: PaperNumbers | None = None
    note: str = ""


PUBLISHED = Row("published", "Neural Bokeh as published", paper=PaperNumbers(42.0, 0.981, 0.017))
GATED = Row("gated", "gated form (this project)", start="demo", note="with its own learning rate, crops and loss, as in the preset `demo`")

_VARIANTS = (
    PUBLISHED,
    Row("3x3", "3x3 kernel size", network={"kernels": "3x3"}, paper=PaperNumbers(36.9, 0.971, 0.030), note="as many blocks"),
    Row("no_tiling", "no tiling", network=_NO_TILES, paper=PaperNumbers(35.3, 0.964, 0.035)),
    Row("no_overlap", "tiling without overlap", network={"overlap_px": 0}, paper=PaperNumbers(40.2, 0.980, 0.018)),
    Row("loss_per_tile", "loss per tile", training={"loss_scope": "tile"}, paper=PaperNumbers(38.1, 0.979, 0.022)),
)
_OTHERS = (
    PUBLISHED,
    Row(
        "neural_camera",
        "Neural Cameras' form",
        network={"form": "neural_camera", "blocks": 3, "initialisation": "identity", **_NO_TILES},
        training={"learning_rate": 0.01},
        note="our reading of Mandl et al. 2021, with a learning rate of its own",
    ),
    Row(
        "deepfocus",
        "DeepFocus' form",
        network={"form": "deepfocus", "initialisation": "identity", **_NO_TILES},
        training={"learning_rate": 0.002},
        note="our reading of Xiao et al. 2018, with a learning rate of its own",
    ),
    GATED,
)
_IMPROVEMENTS = (
    PUBLISHED,
    Row("signed_coc", "signed circle of confusion", network={"signed_coc": True}),
    Row(
        "field_position",
        "field position instead of tiles",
        network={"field_position": True, **_NO_TILES},
        note="to be read beside no tiling of Table 1",
    ),
    Row(
        "wide",
        "8 features a colour, mixed by 1x1 convolutions",
        network={"width": 8, "mixing": "tile", "initialisation": "disc", "activation": "identity"},
        note="a wider reading of per-channel convolutions, which can hold a colour and know its blur",
    ),
    Row("energy_edge", "energy and edge loss", training={"energy_weight": 1.0, "edge_weight": 1.0}),
    Row("depth_noise", "depth noise", training={"depth_noise": 1.0}, note="gains where the depth of the data is worse than its truth"),
    Row("lens_inputs", "f-number and focal length as inputs", network={"lens_inputs": True}, note="gains on data of several settings"),
    GATED,
    Row(
        "gated_field",
        "gated form with field position",
        start="demo",
        network={"field_position": True, "field_bases": 4},
        note="four kernels per bin, between which the place chooses",
    ),
)

TABLES: dict[TableName, tuple[Row, ...]] = {"1": _VARIANTS, "3": _OTHERS, "improvements": _IMPROVEMENTS}

PAPER_TABLE_3: dict[str, dict[str, PaperNumbers]] = {
    bokeh: {
        "published": PaperNumbers(*ours),
        "neural_camera": PaperNumbers(*neural_camera),
        "deepfocus": PaperNumbers(*deepfocus),
    }
    for bokeh, ours, neural_camera, deepfocus in (
        ("heart", (42.1, 0.983, 0.015), (26.7, 0.912, 0.095), (29.4, 0.919, 0.095)),
        ("circle", (41.3, 0.976, 0.020), (25.6, 0.856, 0.107), (31.6, 0.916, 0.103)),
        ("bladed", (42.3, 0.983, 0.016), (26.4, 0.915, 0.091), (35.2, 0.967, 0.031)),
        ("round", (42.3, 0.982, 0.017), (26.0, 0.912, 0.094), (35.2, 0.972, 0.039)),
        ("35mm", (26.2, 0.946, 0.057), (21.6, 0.896, 0.083), (23.6, 0.921, 0.068)),
        ("28mm", (31.2, 0.944, 0.133), (28.7, 0.920, 0.142), (29.7, 0.932, 0.155)),
    )
}
"""The paper's numbers by bokeh and row. It calls its two lenses Nikkor 35mm (Nikon Z6) and Nikkor 28mm (Nikon D3300)."""


def rows_of(tables: tuple[TableName, ...]) -> list[Row]:
    """Return every row once, in the order of the tables."""
    return list({row.name: row for table in tables for row in TABLES[table]}.values())


def paper_numbers(row: Row, table: TableName, set_names: tuple[str, ...]) -> PaperNumbers | None:
    """Return the paper's numbers for a row: those of Table 3 if the data set is named after one of its bokeh."""
    if table == "3":
        names = {name: name for name in PAPER_TABLE_3} | _OUR_NAMES
        bokeh = next((names[name] for name in names if len(set_names) == 1 and name in set_names[0].lower()), None)
        return None if bokeh is None else PAPER_TABLE_3[bokeh].get(row.name)
    return row.paper


@dataclass(frozen=True)
class Ablation:
    """Options shared by all runs.

    minutes or epochs: the budget of each. tile_px, overlap_px: of rows with tiles, None scales those of the settings, which belong to
    pictures of 1920 px, with the width of the pictures, so that there are as many tiles as in the paper.
    base: what the rows of the published form start from.
    """

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
    """A data set or scene folder by its name in tables; held_out: names of the stacks that no run trains on."""

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
    """Read the data sets. Raises InputError if two have one name, or if nothing is held out."""
    sets = [_data_set(folder) for folder in folders]
    names = [each.name for each in sets]
    if len(set(names)) < len(names):
        raise InputError(f"tables name data sets by their folders, got {', '.join(names)}: rename one")
    return sets


def planned_runs(rows: Sequence[Row], data_sets: Sequence[DataSet], out: Path, ablation: Ablation) -> list[PlannedRun]:
    """Plan seed by seed and row by row, so that an unfinished table has as many whole rounds as possible."""
    return [
        PlannedRun(
            row=row,
            seed=seed,
            data_set=each,
            settings=settings_of(row, each.width_px, seed, ablation),
            folder=run_folder(out, each.name, row, seed),
        )
        for seed in range(ablation.seeds)
        for row in rows
        for each in data_sets
    ]


def run_folder(out: Path, set_name: str, row: Row, seed: int) -> Path:
    return out / "runs" / set_name / row.name / f"seed_{seed}"


def settings_of(row: Row, width_px: int, seed: int, ablation: Ablation) -> TrainSettings:
    """Return the settings of a row for pictures of that width."""
    base = ablation.base if ablation.base is not None and row.start == "paper" else PRESETS[row.start]()
    tiles = scaled_tiles(base, width_px, ablation) if base.network.tile_px else {}
    network = replace(base.network, **tiles | dict(row.network))
    budget: dict[str, Any] = {"minutes": ablation.minutes, "epochs": ablation.epochs, "patience": 0}
    place: dict[str, Any] = {"device": ablation.device, "threads": ablation.threads, "seed": seed}
    return replace(base, network=network, **budget | place | dict(row.training))


def scaled_tiles(base: TrainSettings, width_px: int, ablation: Ablation) -> dict[str, Any]:
    """Return tile_px and overlap_px: those requested, else in proportion to the width of the picture."""
    scale = width_px / PAPER_WIDTH_PX
    tile_px = ablation.tile_px if ablation.tile_px is not None else max(2, round(base.network.tile_px * scale))
    overlap_px = ablation.overlap_px if ablation.overlap_px is not None else round(base.network.overlap_px * scale)
    return {"tile_px": tile_px, "overlap_px": overlap_px}


def _data_set(folder: Path) -> DataSet:
    """Read a data set; the split is the manifest's, or for scene folders drawn once for all rows and seeds."""
    data = training_data([folder])
    focal_stacks(data.stacks)
    split = data.split((), TEST_FRACTION, SPLIT_SEED)
    if not split.test or split.held_out_slices:
        raise InputError(f"{folder} has {len(data.stacks)} stack and none to test on: give data with at least two viewpoints")
    names = tuple(stack_name(stack) for stack in split.test)
    return DataSet(name=folder.resolve().name, folder=folder, data=data, held_out=names, width_px=slice_size_px(data.stacks[0], 0)[1])
