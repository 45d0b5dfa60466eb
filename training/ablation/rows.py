"""The rows of the tables as data: what each one changes, and the numbers that the paper has for it (Mandl et al. 2024, Tables 1 and 3).

Every row changes the first row of its table, the network as published; rows of the same name are one run, whatever table they are in.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Literal

TableName = Literal["1", "3", "improvements"]


@dataclass(frozen=True)
class PaperNumbers:
    psnr_db: float
    ssim: float
    lpips: float


@dataclass(frozen=True)
class Row:
    """name: of its runs. start: the preset that it changes. network, training: settings (training.network_settings, training.settings)
    that differ from it. paper: of Table 1. note: what one must know to read the number."""

    name: str
    title: str
    start: Literal["paper", "demo"] = "paper"
    network: Mapping[str, Any] = field(default_factory=dict)
    training: Mapping[str, Any] = field(default_factory=dict)
    paper: PaperNumbers | None = None
    note: str = ""


_NO_TILES = {"tile_px": 0, "overlap_px": 0}

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
TITLES: dict[TableName, str] = {
    "1": "Variants of the design (the paper's Table 1)",
    "3": "Against other networks, by data set (the paper's Table 3)",
    "improvements": "Improvements, one at a time",
}
FILE_NAMES: dict[TableName, str] = {"1": "table_1", "3": "table_3", "improvements": "improvements"}

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

_OUR_NAMES = {"ring": "circle"}
"""Shapes of datasets_scripts.bokeh_stacks that are called otherwise in the paper."""


def rows_of(tables: tuple[TableName, ...]) -> list[Row]:
    """Every row once, in the order of the tables."""
    return list({row.name: row for table in tables for row in TABLES[table]}.values())


def paper_numbers(row: Row, table: TableName, set_names: tuple[str, ...]) -> PaperNumbers | None:
    """What the paper has for a row: of Table 3 where the data set is called after one of its bokeh."""
    if table == "3":
        names = {name: name for name in PAPER_TABLE_3} | _OUR_NAMES
        bokeh = next((names[name] for name in names if len(set_names) == 1 and name in set_names[0].lower()), None)
        return None if bokeh is None else PAPER_TABLE_3[bokeh].get(row.name)
    return row.paper
