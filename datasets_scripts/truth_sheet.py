"""A contact sheet of one view of a truth set: what is sharp, its depth and layers, then every opening at every focus."""

from pathlib import Path
from typing import Any

import numpy as np

from datasets_scripts.truth_tracer import Picture
from mrbokeh.images.exr_io import read_exr
from mrbokeh.images.image_io import SheetRow, read_image, read_layer, write_contact_sheet
from mrbokeh.system.atomic_files import read_json


def write_sheet(folder: Path) -> None:
    """folder/sheet.png, three pictures to a row."""
    meta = read_json(folder / "meta.json", "the description of a view (meta.json)")
    sharp, depth_m = read_image(folder / "all_in_focus.exr"), read_exr(folder / "depth.exr")[0].channels["Z"]
    lamps = np.maximum(sharp - 1.0, 0.0)
    rows = [
        SheetRow("sharp", {"all in focus": sharp, "dioptres, 1.5 is white": _grey(1.0 / depth_m / 1.5), "what is brighter than 1": lamps})
    ]
    if meta["layers"]:
        front, rest = (read_layer(folder / name) for name in meta["layers"])
        rows.append(SheetRow("layers", {"foreground": front.rgb, "its coverage": _grey(front.alpha), "the rest without it": rest.rgb}))
    rows += [_truth_row(folder, meta, shape) for shape in meta["truth"]]
    write_contact_sheet(folder / "sheet.png", rows)


def _truth_row(folder: Path, meta: dict[str, Any], shape: str) -> SheetRow:
    captions = [f"focus {distance_m:.2f} m" for distance_m in meta["focus_distances_m"]]
    return SheetRow(shape, {caption: read_image(folder / name) for caption, name in zip(captions, meta["truth"][shape], strict=True)})


def _grey(plane: np.ndarray) -> Picture:
    return np.repeat(plane[..., None], 3, axis=-1).astype(np.float32)
