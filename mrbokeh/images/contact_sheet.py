"""A sheet of labelled pictures: one row per slice, one column per method."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float32, UInt8

from mrbokeh.images.color import display_rgb8
from mrbokeh.images.picture_codec import write_stored

WIDEST_PX = 320
LABEL_PX = 18
GAP_PX = 4
FONT_SCALE = 0.36


@dataclass(frozen=True)
class SheetRow:
    """Pictures (H, W, 3), scene-linear, by their caption."""

    label: str
    pictures: Mapping[str, Float32[np.ndarray, "height width 3"]]


def write_contact_sheet(path: Path, rows: Sequence[SheetRow]) -> None:
    """An 8-bit PNG for people to look at; pictures wider than 320 px are made smaller."""
    write_stored(path, np.concatenate([_row(each) for each in rows], axis=0))


def _row(row: SheetRow) -> UInt8[np.ndarray, "sheet_height sheet_width 3"]:
    cells = [_cell(f"{row.label}: {caption}" if i == 0 else caption, picture) for i, (caption, picture) in enumerate(row.pictures.items())]
    return np.concatenate(cells, axis=1)


def _cell(caption: str, picture: Float32[np.ndarray, "height width 3"]) -> UInt8[np.ndarray, "sheet_height sheet_width 3"]:
    import cv2

    height, width = picture.shape[:2]
    shrink = min(1.0, WIDEST_PX / width)
    small = cv2.resize(picture, (round(width * shrink), round(height * shrink)), interpolation=cv2.INTER_AREA)
    shown = display_rgb8(np.clip(small, 0.0, 1e4).astype(np.float32))
    cell = np.full((shown.shape[0] + LABEL_PX + GAP_PX, shown.shape[1] + GAP_PX, 3), 255, np.uint8)
    cell[LABEL_PX:-GAP_PX, :-GAP_PX] = shown
    cv2.putText(
        cell, caption, (2, LABEL_PX - 5), cv2.FONT_HERSHEY_SIMPLEX, _font_scale(caption, cell.shape[1] - 4), (0, 0, 0), 1, cv2.LINE_AA
    )
    return cell


def _font_scale(caption: str, width_px: int) -> float:
    """The usual one, or smaller, so that a caption does not run into the next."""
    import cv2

    (length_px, _), _ = cv2.getTextSize(caption, cv2.FONT_HERSHEY_SIMPLEX, FONT_SCALE, 1)
    return FONT_SCALE * min(1.0, width_px / max(length_px, 1))
