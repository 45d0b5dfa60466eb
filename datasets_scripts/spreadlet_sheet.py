"""A sheet of details: what the methods of a table make of the same place, as in Leimkuehler et al. 2018, Fig. 8."""

from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np

from datasets_scripts.blur_rows import Row
from mrbokeh.images.image_io import SheetRow, read_image, write_contact_sheet

DETAIL_SHARE = (0.22, 0.22)
"""Height and width of a detail over those of the picture."""
_METHODS = {"ours": "OURS", "filter": "FILTER", "splat": "SPLAT", "reference": "REFERENCE"}


def write_details(folder: Path, rows: Sequence[Row], path: Path) -> None:
    """One row for each of the rows that all methods have a picture of in FOLDER: the place where filtering is farthest off."""
    sheet = []
    for row in rows:
        files = {name: folder / f"{row.name}_{key}.exr" for key, name in _METHODS.items()}
        if all(file.is_file() for file in files.values()):
            pictures = {name: read_image(file) for name, file in files.items()}
            part = _farthest_off(np.abs(np.clip(pictures["FILTER"], 0.0, 1.0) - np.clip(pictures["REFERENCE"], 0.0, 1.0)).mean(axis=2))
            sheet.append(SheetRow(row.scene, {name: np.ascontiguousarray(picture[part]) for name, picture in pictures.items()}))
    if sheet:
        write_contact_sheet(path, sheet)


def _farthest_off(error: np.ndarray) -> tuple[slice, slice]:
    """The window within the picture with the largest mean error."""
    height, width = (max(1, round(share * length)) for share, length in zip(DETAIL_SHARE, error.shape, strict=True))
    # A box filter with its anchor in the top left corner; only windows that lie within the picture count.
    means = cv2.boxFilter(error, -1, (width, height), anchor=(0, 0))[: error.shape[0] - height + 1, : error.shape[1] - width + 1]
    top, left = np.unravel_index(int(means.argmax()), means.shape)
    return slice(int(top), int(top) + height), slice(int(left), int(left) + width)
