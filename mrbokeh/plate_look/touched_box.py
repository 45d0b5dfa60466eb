"""The part of a picture that virtual light reaches: what lies outside is the photograph's and stays bit for bit."""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from mrbokeh.compositing.base import Inserted
from mrbokeh.layer import Layer


@dataclass(frozen=True)
class Box:
    """Rows top to bottom and columns left to right (ends excluded) of a picture of frame_px (height, width)."""

    top: int
    bottom: int
    left: int
    right: int
    frame_px: tuple[int, int]

    @property
    def is_empty(self) -> bool:
        return self.bottom <= self.top or self.right <= self.left

    @property
    def size_px(self) -> tuple[int, int]:
        return self.bottom - self.top, self.right - self.left

    @property
    def origin_px(self) -> tuple[int, int]:
        return self.top, self.left

    def grown(self, margin_px: int) -> "Box":
        """To all sides, as far as the frame goes."""
        height, width = self.frame_px
        top, left = max(self.top - margin_px, 0), max(self.left - margin_px, 0)
        return replace(self, top=top, left=left, bottom=min(self.bottom + margin_px, height), right=min(self.right + margin_px, width))

    def of(self, picture: np.ndarray) -> Any:
        return picture[self.top : self.bottom, self.left : self.right]

    def of_layer(self, layer: Layer) -> Layer:
        return Layer(self.of(layer.rgb), self.of(layer.alpha), self.of(layer.depth_m))


def touched_box(inserted: Inserted) -> Box:
    """The smallest box with all pixels that have coverage or light of the virtual layers."""
    from mrbokeh.plate_look._grain_numba import touched_rows_and_columns

    layer = inserted.virtual
    rows, columns = (np.flatnonzero(each) for each in touched_rows_and_columns(layer.alpha, layer.rgb))
    if not len(rows):
        return Box(0, 0, 0, 0, layer.alpha.shape)
    return Box(int(rows[0]), int(rows[-1]) + 1, int(columns[0]), int(columns[-1]) + 1, layer.alpha.shape)
