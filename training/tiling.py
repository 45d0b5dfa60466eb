"""Overlapping tiles: a picture as tiles stacked along the channels, and back with overlaps averaged (Neural Bokeh, Section 3.2).

Annotations are plain tensors with shapes in words: exporting traces these functions with sizes that are symbols, which a
shape check would freeze.
"""

import functools
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn import functional


@dataclass(frozen=True)
class TileGrid:
    """Where the tiles of a picture lie.

    Neighbouring tiles start tile_px - overlap_px apart; the last one is shifted back to end at the border, so that every tile
    is whole. A picture smaller than a tile has one tile of its own size along that side.
    """

    height_px: int
    width_px: int
    tile_px: int
    overlap_px: int

    @property
    def tile_size_px(self) -> tuple[int, int]:
        """(height, width) of every tile."""
        return min(self.tile_px, self.height_px), min(self.tile_px, self.width_px)

    @property
    def origins_px(self) -> tuple[tuple[int, int], ...]:
        """(top, left) of the tiles, row by row."""
        rows, columns = (_starts(length, self.tile_px, self.overlap_px) for length in (self.height_px, self.width_px))
        return tuple((top, left) for top in rows for left in columns)

    def __len__(self) -> int:
        return len(self.origins_px)


def _starts(length_px: int, tile_px: int, overlap_px: int) -> list[int]:
    last = max(0, length_px - tile_px)
    return [*range(0, last, tile_px - overlap_px), last]


def split(picture: Tensor, grid: TileGrid) -> Tensor:
    """(B, C, H, W) to (B, tiles * C, t, t): the channels of the first tile, then those of the second, and so on."""
    height, width = grid.tile_size_px
    return torch.cat([picture[:, :, top : top + height, left : left + width] for top, left in grid.origins_px], dim=1)


def assemble(tiles: Tensor, grid: TileGrid) -> Tensor:
    """(B, tiles * C, t, t) to (B, C, H, W): every tile at its place, the mean where they overlap."""
    return _sum_placed(tiles.chunk(len(grid), dim=1), grid) / tile_count(grid).to(tiles)


def tile_count(grid: TileGrid) -> Tensor:
    """(H, W): how many tiles cover each pixel."""
    return _sum_placed([torch.ones(1, 1, *grid.tile_size_px)] * len(grid), grid)[0, 0]


def _sum_placed(tiles: Sequence[Tensor], grid: TileGrid) -> Tensor:
    placed = [_placed(tile, origin, grid) for tile, origin in zip(tiles, grid.origins_px, strict=True)]
    return functools.reduce(torch.add, placed)


def _placed(tile: Tensor, origin_px: tuple[int, int], grid: TileGrid) -> Tensor:
    """A tile in a picture that is 0 elsewhere."""
    (top, left), (height, width) = origin_px, grid.tile_size_px
    return functional.pad(tile, (left, grid.width_px - left - width, top, grid.height_px - top - height))
