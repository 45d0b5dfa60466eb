"""The frame of all networks: a sharp picture and its circles of confusion in, a blurred picture out (Mandl et al. 2024, Section 3).

Ranges, tiles and inputs are here; the four forms are in published_network.py, gated_network.py and baseline_networks.py. The circle
of confusion enters as a fraction of the largest one, mapped to [-1, 1] as the colours are; f-number and focal length enter in stops
and octaves over the range of training. Overlapping tiles are stacked along the channels, and overlaps averaged (Section 3.2).

Shapes are in words here, not in annotations: exporting traces with sizes that are symbols, which a shape check would freeze.
"""

import functools
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import torch
from torch import Tensor, nn
from torch.nn import functional

from mrbokeh.stacks.focal_stack_dataset import network_blocks
from mrbokeh.system.errors import InputError
from training.networks.network_settings import NetworkSettings

LensRanges = tuple[tuple[float, float], tuple[float, float]]
"""((lowest, highest f-number), (lowest, highest focal length in mm))."""

LEAST_RATIO = 2.0


class LensScale(nn.Module):
    """Map (B, 2) f-number and focal length in mm to (B, 2) in [-1, 1]: the logarithm of each, its trained range from -1 to 1.

    Logarithms, because blur follows ratios of both. A range narrower than a factor of 2 counts as that wide about its middle, so
    that what hardly varied in training is hardly amplified. The ranges belong to the run, not to the weights: they are not saved with them.
    """

    middle: Tensor
    half_width: Tensor

    def __init__(self, ranges: LensRanges) -> None:
        super().__init__()
        logs = torch.tensor([[math.log(low), math.log(high)] for low, high in ranges])
        half_width = 0.5 * (logs[:, 1] - logs[:, 0]).clamp(min=math.log(LEAST_RATIO))
        self.register_buffer("middle", logs.mean(dim=1), persistent=False)
        self.register_buffer("half_width", half_width, persistent=False)

    def forward(self, lens: Tensor) -> Tensor:
        return (torch.log(lens) - self.middle) / self.half_width


@dataclass(frozen=True)
class TileGrid:
    """Positions of the tiles of a picture.

    Neighbouring tiles start tile_px - overlap_px apart; the last one is shifted back to end at the border, so that every tile
    is whole. A picture smaller than a tile has one tile of its own size along that side.
    """

    height_px: int
    width_px: int
    tile_px: int
    overlap_px: int

    @property
    def tile_size_px(self) -> tuple[int, int]:
        """Return (height, width) of every tile."""
        return min(self.tile_px, self.height_px), min(self.tile_px, self.width_px)

    @property
    def origins_px(self) -> tuple[tuple[int, int], ...]:
        """Return (top, left) of the tiles, row by row."""
        rows, columns = (_starts(length, self.tile_px, self.overlap_px) for length in (self.height_px, self.width_px))
        return tuple((top, left) for top in rows for left in columns)

    def __len__(self) -> int:
        return len(self.origins_px)


class BlurNetwork(nn.Module):
    """A network from linear radiance and circles of confusion to linear radiance, with tiling and the mapping to [-1, 1] inside.

    radiance_scale: the largest radiance of the data; `headroom` times it becomes +1 inside, 0 becomes -1.
    grid: the tiles, for one size of picture; None takes the whole picture as one tile of any size.
    lens_ranges: of training, for a network that takes the lens as input.
    linear_in_radiance: doubled light gives a doubled result. reach_px: how far from a pixel the network looks.
    """

    def __init__(
        self,
        settings: NetworkSettings,
        largest_coc_px: float,
        radiance_scale: float,
        grid: TileGrid | None = None,
        lens_ranges: LensRanges | None = None,
    ) -> None:
        super().__init__()
        self.signed_coc, self.field_position = settings.signed_coc, settings.field_position
        self.largest_coc_px, self.radiance_scale, self.grid = largest_coc_px, radiance_scale, grid
        self.top = settings.headroom * radiance_scale
        self.lens_scale = _lens_scale(lens_ranges) if settings.lens_inputs else None
        form = form_of(settings, largest_coc_px, 1 if grid is None else len(grid))
        self.linear_in_radiance, self.reach_px = form.linear_in_radiance, form.reach_px
        assert isinstance(form, nn.Module)
        self.tiles: nn.Module = form

    def forward(self, rgb: Tensor, coc_px: Tensor, place: Tensor | None = None, lens: Tensor | None = None) -> Tensor:
        """Blur rgb (B, 3, H, W) linear with coc_px (B, 1, H, W) signed diameters; the result is (B, 3, H, W) linear.

        place (B, 2, H, W), field positions, and lens (B, 2), f-number and focal length in mm, are needed if the settings say so.
        """
        y = self._tiles(rgb, coc_px, place, lens)
        return self._radiance(y if self.grid is None else assemble(y, self.grid))

    def tile_outputs(self, rgb: Tensor, coc_px: Tensor, place: Tensor | None = None, lens: Tensor | None = None) -> Tensor:
        """Return (B, 3 tiles, t, t) linear: the result of every tile, before overlaps are averaged."""
        return self._radiance(self._tiles(rgb, coc_px, place, lens))

    def encode(self, rgb: Tensor, coc_px: Tensor, place: Tensor | None = None, lens: Tensor | None = None) -> Tensor:
        """Return the network's input (B, C, H, W), all in [-1, 1]: R, G, B, circle of confusion, then place and lens if they are used."""
        fraction = coc_px / self.largest_coc_px
        coc = fraction.clamp(-1.0, 1.0) if self.signed_coc else 2.0 * fraction.abs().clamp(max=1.0) - 1.0
        planes = [rgb * (2.0 / self.top) - 1.0, coc]
        if self.field_position:
            planes.append(_given(place, "place (B, 2, H, W)", "field_position"))
        if self.lens_scale is not None:
            scaled = self.lens_scale(_given(lens, "lens (B, 2)", "lens_inputs"))
            planes.append(scaled[:, :, None, None].expand(-1, -1, *coc.shape[2:]))
        return torch.cat(planes, dim=1)

    def _tiles(self, rgb: Tensor, coc_px: Tensor, place: Tensor | None, lens: Tensor | None) -> Tensor:
        x = self.encode(rgb, coc_px, place, lens)
        y: Tensor = self.tiles(x if self.grid is None else split(x, self.grid))
        return y

    def _radiance(self, y: Tensor) -> Tensor:
        return (y + 1.0) * (0.5 * self.top)


@runtime_checkable
class Form(Protocol):
    """The computing part, an nn.Module: x (B, C tiles, t, t) to y (B, 3 tiles, t, t), colours in [-1, 1]."""

    linear_in_radiance: bool
    reach_px: int


def form_of(settings: NetworkSettings, largest_coc_px: float, tiles: int) -> Form:
    """Build a fresh network of that form; N follows from the largest circle of confusion unless the settings give it."""
    if settings.form == "gated":
        from training.networks.gated_network import GatedTiles, blocks_for_gates

        return GatedTiles(settings, settings.blocks or blocks_for_gates(largest_coc_px), largest_coc_px, tiles)
    blocks = settings.blocks or network_blocks(largest_coc_px)
    if settings.form == "deepfocus":
        from training.networks.baseline_networks import DeepFocusTiles

        return DeepFocusTiles(settings, blocks, largest_coc_px, tiles)
    if settings.form == "neural_camera":
        from training.networks.baseline_networks import NeuralCameraTiles

        return NeuralCameraTiles(settings, blocks, largest_coc_px, tiles)
    from training.networks.published_network import PublishedTiles

    return PublishedTiles(settings, blocks, largest_coc_px, tiles)


def _lens_scale(ranges: LensRanges | None) -> LensScale:
    if ranges is None:
        raise InputError(
            "a network with lens_inputs needs the ranges of f-number and focal length that it is trained on: give lens_ranges, "
            "or set lens_inputs to false"
        )
    return LensScale(ranges)


def _given(values: Tensor | None, what: str, setting: str) -> Tensor:
    if values is None:
        raise InputError(f"this network was made with {setting}, so it needs {what} beside the picture, got none: give it")
    return values


def _starts(length_px: int, tile_px: int, overlap_px: int) -> list[int]:
    last = max(0, length_px - tile_px)
    return [*range(0, last, tile_px - overlap_px), last]


def split(picture: Tensor, grid: TileGrid) -> Tensor:
    """Split (B, C, H, W) into (B, tiles * C, t, t): the channels of the first tile, then those of the second, and so on."""
    height, width = grid.tile_size_px
    return torch.cat([picture[:, :, top : top + height, left : left + width] for top, left in grid.origins_px], dim=1)


def assemble(tiles: Tensor, grid: TileGrid) -> Tensor:
    """Assemble (B, tiles * C, t, t) to (B, C, H, W): every tile at its place, the mean where they overlap."""
    is_traced = torch.compiler.is_exporting() or torch.compiler.is_compiling()
    count = tile_count(grid, tiles.device).to(tiles) if is_traced else _count_on(grid, tiles.device, tiles.dtype)
    return _sum_placed(tiles.chunk(len(grid), dim=1), grid) / count


def tile_count(grid: TileGrid, device: torch.device | None = None) -> Tensor:
    """Return (H, W): how many tiles cover each pixel."""
    return _sum_placed([torch.ones(1, 1, *grid.tile_size_px, device=device)] * len(grid), grid)[0, 0]


@functools.lru_cache(maxsize=4)
def _count_on(grid: TileGrid, device: torch.device, precision: torch.dtype) -> Tensor:
    """Return `tile_count` on the device, made once: it takes longer than a small network. Made in inference mode it could not be used
    while training.
    """
    with torch.inference_mode(False):
        return tile_count(grid, device).to(precision)


def _sum_placed(tiles: Sequence[Tensor], grid: TileGrid) -> Tensor:
    placed = [_placed(tile, origin, grid) for tile, origin in zip(tiles, grid.origins_px, strict=True)]
    return functools.reduce(torch.add, placed)


def _placed(tile: Tensor, origin_px: tuple[int, int], grid: TileGrid) -> Tensor:
    """Place a tile in a picture that is 0 elsewhere."""
    (top, left), (height, width) = origin_px, grid.tile_size_px
    return functional.pad(tile, (left, grid.width_px - left - width, top, grid.height_px - top - height))
