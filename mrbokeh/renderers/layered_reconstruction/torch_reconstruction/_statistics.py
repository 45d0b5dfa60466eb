"""Sums over the samples of each tile and bucket, from all samples or a sparse stratified choice in Morton order."""

from collections.abc import Iterator
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import torch
from jaxtyping import Bool, Float64, Int8, Int64
from torch import Tensor

from mrbokeh.renderers.layered_reconstruction.torch_reconstruction._filter import features
from mrbokeh.renderers.layered_reconstruction.torch_reconstruction._light import BLOCKS, TileLight, block_at, place_of

_CHOSEN, _WITHIN, _OUTSIDE = 3, 2, 1
_WORD = np.uint64(0xFFFFFFFF)


@dataclass(frozen=True)
class Rows:
    """Buckets that a tile or its surroundings hold, tile by tile, in the order of buckets.

    sums: (R, 8). tile, bucket: (R,). first: (T + 1,) the first row of each tile, and the end. place: (T, U) the row of every
    bucket of a tile, -1 where it holds none. light: (R, 3) number, light and its root of all samples of the tile and the blocks
    around it.
    """

    sums: Float64[Tensor, "rows 8"]
    light: Float64[Tensor, "rows 3"]
    tile: Int64[Tensor, " rows"]
    bucket: Int64[Tensor, " rows"]
    first: Int64[Tensor, " tiles_and_end"]
    place: Int64[Tensor, "tiles buckets"]


def tile_rows(light: TileLight, every: int, seed: int) -> Rows:
    """Statistics of what a tile holds, from one sample of `every`, and of what only the blocks around it hold; waits for their number.

    Buckets of which no sample was chosen are summed from all of theirs, and count as much as the others.
    """
    tiles, buckets = light.rows * light.columns, light.buckets
    cell = light.block * buckets + light.bucket
    chosen = chosen_samples(light, every, seed)
    holds = torch.zeros((tiles * BLOCKS + 1, buckets), dtype=torch.bool, device=cell.device)
    holds.view(-1)[cell] = True
    ring = ring_of_tiles(light.columns, light.rows, cell.device)
    kind = _kinds(holds, ring)
    kind.view(-1)[light.block[chosen] // BLOCKS * buckets + light.bucket[chosen]] = _CHOSEN
    held = torch.nonzero(kind.view(-1))[:, 0]
    place = torch.where(kind > 0, torch.cumsum(kind.view(-1) > 0, 0).view(kind.shape) - 1, -1)
    needed = torch.nonzero(_needed(kind, ring).view(-1)[cell])[:, 0]
    sums = torch.zeros((len(held), 8), dtype=torch.float64, device=cell.device)
    for sample, tile in ((chosen, light.block[chosen] // BLOCKS), *_unchosen(light, needed, kind)):
        sums.index_add_(0, place[tile, light.bucket[sample]], features(light.slopes[sample]))
    sums /= torch.where(kind.view(-1)[held] == _CHOSEN, 1, every)[:, None]
    tile = held // buckets
    first = torch.searchsorted(tile, torch.arange(tiles + 1, device=cell.device))
    return Rows(sums, _light_of_rows(light, place, len(held)), tile, held % buckets, first, place)


def _light_of_rows(light: TileLight, place: Int64[Tensor, "tiles buckets"], rows: int) -> Float64[Tensor, "rows 3"]:
    most = light.values.abs().amax(dim=1)
    of_samples = torch.stack([torch.ones_like(most), most, torch.sqrt(most)], dim=1).double()
    sums = of_samples.new_zeros((rows, 3))
    for sample, tile, _ in _touched(light, torch.arange(len(most), device=most.device)):
        sums.index_add_(0, place[tile, light.bucket[sample]], of_samples[sample])
    return sums


def chosen_samples(light: TileLight, every: int, seed: int) -> Int64[Tensor, " chosen"]:
    """One of every so many samples of a tile, the last of those left."""
    device = light.block.device
    if every == 1:
        return torch.arange(len(light.block), device=device)
    first, end = light.starts[:-1:BLOCKS, None], light.starts[BLOCKS::BLOCKS, None]
    steps = -(-light.most_in_tile // every)
    begin = first + torch.arange(steps, device=device) * every
    left = (end - begin).clamp(1, every)
    return (begin + chance(seed, len(first), steps, device) % left)[begin < end]


@lru_cache(maxsize=4)
def chance(seed: int, tiles: int, steps: int, device: torch.device) -> Int64[Tensor, "tiles steps"]:
    """The first numbers of a xor-shift generator of each tile (Marsaglia 2003), those of the compiled renderer."""
    start = np.uint64(seed * 2654435761 + 374761393 & 0xFFFFFFFF)
    state = (start + np.arange(tiles, dtype=np.uint64) * np.uint64(2246822519)) & _WORD
    state = np.where(state == 0, np.uint64(1), state)
    for _ in range(4):
        state = _xorshift(state)
    numbers = np.empty((tiles, steps), np.int64)
    for k in range(steps):
        state = _xorshift(state)
        numbers[:, k] = state
    return torch.from_numpy(numbers).to(device)


def _xorshift(state: np.ndarray) -> np.ndarray:
    state = state ^ (state << np.uint64(13)) & _WORD
    state = state ^ state >> np.uint64(17)
    return state ^ (state << np.uint64(5)) & _WORD


@lru_cache(maxsize=4)
def ring_of_tiles(columns: int, rows: int, device: torch.device) -> Int64[Tensor, "20 tiles"]:
    """The blocks of other tiles that touch each tile; one beyond the last block outside of the picture."""
    tile = torch.arange(columns * rows, device=device)
    ring = []
    for step_y in range(-1, 5):
        for step_x in range(-1, 5):
            if not (0 <= step_x < 4 and 0 <= step_y < 4):
                x, y = tile % columns * 4 + step_x, tile // columns * 4 + step_y
                inside = (x >= 0) & (x < 4 * columns) & (y >= 0) & (y < 4 * rows)
                ring.append(torch.where(inside, block_at(x.clamp(min=0), y.clamp(min=0), columns), BLOCKS * len(tile)))
    return torch.stack(ring)


def _kinds(holds: Bool[Tensor, "blocks_and_none buckets"], ring: Int64[Tensor, "20 tiles"]) -> Int8[Tensor, "tiles buckets"]:
    """Which buckets a tile holds, and which only the blocks around it hold."""
    within = holds[:-1].view(-1, BLOCKS, holds.shape[1]).any(dim=1)
    around = holds[ring[0]]
    for blocks in ring[1:]:
        around |= holds[blocks]
    return torch.maximum(within.to(torch.int8) * _WITHIN, around.to(torch.int8) * _OUTSIDE)


def _needed(kind: Int8[Tensor, "tiles buckets"], ring: Int64[Tensor, "20 tiles"]) -> Bool[Tensor, "blocks_and_none buckets"]:
    """Buckets of each block whose samples count although none was chosen, in its own tile or in one that it touches."""
    within, outside = kind == _WITHIN, kind == _OUTSIDE
    needed = torch.cat([within.repeat_interleave(BLOCKS, dim=0), torch.zeros_like(within[:1])])
    for blocks in ring:
        # A block has the same place in the rings of no two tiles.
        needed[blocks] |= outside
    return needed


def _unchosen(
    light: TileLight, sample: Int64[Tensor, " needed"], kind: Int8[Tensor, "tiles buckets"]
) -> list[tuple[Int64[Tensor, " some"], Int64[Tensor, " some"]]]:
    """Of these samples, those that count for their own tile and for those beside, above or below, and across the corner, each with it."""
    found = []
    for some, tile, outside in _touched(light, sample):
        which = torch.nonzero(kind[tile, light.bucket[some]] == (_OUTSIDE if outside else _WITHIN))[:, 0]
        found.append((some[which], tile[which]))
    return found


def _touched(light: TileLight, sample: Int64[Tensor, " samples"]) -> Iterator[tuple[Int64[Tensor, " some"], Int64[Tensor, " some"], bool]]:
    """Samples with the tile they lie in, then those of them whose block touches a tile beside, above or below, or across the corner,
    with that tile; and whether it is another."""
    x, y = place_of(light.block[sample], light.columns)
    step_x, step_y = (at % 4 // 3 - (3 - at % 4) // 3 for at in (x, y))
    for with_x, with_y in ((0, 0), (1, 0), (0, 1), (1, 1)):
        column, row = x // 4 + with_x * step_x, y // 4 + with_y * step_y
        there = (column >= 0) & (column < light.columns) & (row >= 0) & (row < light.rows)
        there &= ((step_x != 0) | (with_x == 0)) & ((step_y != 0) | (with_y == 0))
        which = torch.nonzero(there)[:, 0]
        yield sample[which], (row * light.columns + column)[which], bool(with_x or with_y)
