"""Overlapping tiles: expected numbers follow from Section 3.2 of Mandl et al. 2024 (200 px tiles, 60 px overlap) by counting."""

import pytest
import torch

from training.networks.network import TileGrid, assemble, split, tile_count


def test_every_pixel_is_covered_by_tiles_that_are_shifted_not_cut() -> None:
    """1920 x 1080, stride 140: starts 0, 140, ... below 1720, then 1720 itself (13 + 1); below 880, then 880 (7 + 1)."""
    grid = TileGrid(1080, 1920, tile_px=200, overlap_px=60)
    assert len(grid) == 14 * 8
    assert grid.origins_px[:2] == ((0, 0), (0, 140))
    assert grid.origins_px[-1] == (1080 - 200, 1920 - 200)
    # 10 px with tiles of 4 and overlap 1: starts 0, 3, 6. 9 px: 0, 3 and the last shifted back to 5.
    assert TileGrid(4, 10, 4, 1).origins_px == ((0, 0), (0, 3), (0, 6))
    grid = TileGrid(4, 9, 4, 1)
    assert grid.origins_px == ((0, 0), (0, 3), (0, 5))
    assert tile_count(grid)[0].tolist() == [1, 1, 1, 2, 1, 2, 2, 1, 1]


@pytest.mark.parametrize("size", [(40, 56), (41, 53), (16, 16), (9, 70), (16, 17)])
@pytest.mark.parametrize("overlap_px", [0, 5])
def test_assembling_what_was_split_gives_the_picture(size: tuple[int, int], overlap_px: int) -> None:
    grid = TileGrid(*size, tile_px=16, overlap_px=overlap_px)
    picture = torch.rand(2, 3, *size, generator=torch.Generator().manual_seed(0))
    tiles = split(picture, grid)
    assert tiles.shape == (2, 3 * len(grid), *grid.tile_size_px)
    assert torch.allclose(assemble(tiles, grid), picture, atol=1e-6)


def test_overlaps_are_averaged_and_channels_of_a_tile_stay_together() -> None:
    """Two tiles of 4 px over 6 px: columns 2 and 3 belong to both, so they show the mean of 1 and 3."""
    grid = TileGrid(4, 6, tile_px=4, overlap_px=2)
    tiles = torch.cat([torch.full((1, 1, 4, 4), 1.0), torch.full((1, 1, 4, 4), 3.0)], dim=1)
    assert assemble(tiles, grid)[0, 0, 0].tolist() == [1.0, 1.0, 2.0, 2.0, 3.0, 3.0]
    # Tile i has channels 4 i to 4 i + 3, as the grouped convolutions expect.
    picture = torch.arange(4.0)[None, :, None, None].expand(1, 4, 8, 12)
    tiles = split(picture, TileGrid(8, 12, tile_px=8, overlap_px=4))
    assert tiles[0, :, 0, 0].tolist() == [0, 1, 2, 3] * 2
