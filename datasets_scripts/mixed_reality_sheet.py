"""A contact sheet of one view of the mixed-reality truth: what is sharp, then every photograph beside the same with the object."""

from pathlib import Path

import numpy as np

from mrbokeh.images.image_io import SheetRow, read_image, read_layer, write_contact_sheet
from mrbokeh.system.atomic_files import read_json


def write_sheet(folder: Path) -> None:
    """folder/sheet.png: sharp scene and object, then per opening the photographs, and under them both traced together."""
    meta = read_json(folder / "meta.json", "the description of a view (meta.json)")
    virtual, scene_rgb = read_layer(folder / "object.exr"), read_image(folder / "scene" / "all_in_focus.exr")
    coverage = np.repeat(virtual.alpha[..., None], 3, axis=2)
    rows = [SheetRow("sharp", {"all in focus": scene_rgb, "the object": virtual.rgb, "its coverage": coverage})]
    for shape, names in meta["truth"].items():
        for what in ("scene", "both"):
            captions = [f"focus {distance_m:.2f} m" for distance_m in meta["focus_distances_m"]]
            pictures = {caption: read_image(folder / what / name) for caption, name in zip(captions, names, strict=True)}
            rows.append(SheetRow(f"{shape}, {what}", pictures))
    write_contact_sheet(folder / "sheet.png", rows)
