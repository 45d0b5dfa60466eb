"""Sheets of predictions on held-out slices, one for every look, so that one can watch a network learn."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float32

from mrbokeh.images.image_io import WIDEST_PX, SheetRow, write_contact_sheet

FOLDER_NAME = "sheets"
MOST_KEPT = 16


def small_picture(picture: Float32[np.ndarray, "height width 3"]) -> Float32[np.ndarray, "small_height small_width 3"]:
    """Shrink a picture to the width at which a sheet shows it, so that whole pictures need not be kept until it is written."""
    import cv2

    height, width = picture.shape[:2]
    scale = min(1.0, WIDEST_PX / width)
    return np.asarray(cv2.resize(picture, (round(width * scale), round(height * scale)), interpolation=cv2.INTER_AREA), np.float32)


def write_sheet(run_folder: Path, step: int, rows: Sequence[SheetRow]) -> None:
    """sheets/step_0000123.png. At most MOST_KEPT are kept: the first, the last, and of the others such that lie far apart."""
    if not rows:
        return
    folder = run_folder / FOLDER_NAME
    write_contact_sheet(folder / f"step_{step:07d}.png", rows)
    kept = sorted(folder.glob("step_*.png"), key=_step)
    while len(kept) > MOST_KEPT:
        closest = min(range(1, len(kept) - 1), key=lambda i: _step(kept[i + 1]) - _step(kept[i - 1]))
        kept.pop(closest).unlink()


def _step(path: Path) -> int:
    return int(path.stem.removeprefix("step_"))
