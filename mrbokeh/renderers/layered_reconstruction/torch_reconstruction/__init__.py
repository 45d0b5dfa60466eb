"""Layered reconstruction (LRDM) by torch: on an NVIDIA GPU, or on any processor that torch runs on (Hasselgren et al. 2015).

The steps are those of `mrbokeh.renderers.layered_reconstruction`, and so are its formulas; what differs is who waits for whom. All
tiles, all partitions and all samples go through each step together:

1. Samples are sorted by tile and put into buckets (`_light`); sums over chosen ones make rows (`_statistics`).
2. Rows of a tile join partitions (`_partitions`), one row of every tile at a time.
3. Each partition of each tile is a job: samples around the tile are reprojected into a window of its own (`_jobs`).
4. The filter of a job is a kernel; kernels and windows meet in a Fourier transform, in double precision (`_screen`).
5. Jobs of a tile are composited front to back, in parts where that makes a difference.

Two steps have a Triton kernel for NVIDIA GPUs beside them, with the same result: the sweep, of which each step is too little work for a
GPU, and the reprojection. The host waits for the device some dozen times a picture, to learn sizes: how many buckets, rows, partitions
and pixels there are, and how wide windows must be. Nothing else goes to and fro. Additions on a GPU come in any order, so that pictures
there are the same to rounding only.

torch comes with the extra `train`; without it, importing this package says so.
"""

try:
    import torch
except ModuleNotFoundError as missing:
    from mrbokeh.system.errors import MissingExtraError

    raise MissingExtraError("torch", "train") from missing

from collections.abc import Iterator
from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Bool, Float32, Int64
from torch import Tensor
from torch.nn.functional import avg_pool2d, interpolate

from mrbokeh.images.layer import Layer, opaque
from mrbokeh.layering.light_field_samples import LightFieldSamples
from mrbokeh.optics.aperture import Aperture
from mrbokeh.optics.lens import Lens
from mrbokeh.renderers.layered_reconstruction._settings import Settings
from mrbokeh.renderers.layered_reconstruction._tiles_numba import COARSE_PX, DARK, MOST_RATIO
from mrbokeh.renderers.layered_reconstruction.torch_reconstruction._jobs import (
    Jobs,
    Task,
    batches,
    groups,
    jobs_in,
    jobs_of,
    reprojected,
    task_of,
)
from mrbokeh.renderers.layered_reconstruction.torch_reconstruction._light import DeviceSamples, TileLight, tile_light
from mrbokeh.renderers.layered_reconstruction.torch_reconstruction._partitions import partitions_of
from mrbokeh.renderers.layered_reconstruction.torch_reconstruction._screen import ScreenFilter
from mrbokeh.renderers.layered_reconstruction.torch_reconstruction._statistics import sheared_slopes, tile_rows
from mrbokeh.system.torch_device import device_named

__all__ = ["DeviceSamples", "TorchReconstruction"]


_LEAST_WEIGHT = 1e-6
_LEAST_TAKEN = 1e-3
Tiles = Float32[Tensor, "tiles channels side side"]
FineTiles = Float32[Tensor, "tiles channels wide wide"]
Coarse = Float32[Tensor, "tiles channels side side"]
AT_ONCE = {"cpu": (1 << 15, 1 << 17, 1 << 22), "cuda": (1 << 22, 1 << 23, 1 << 26)}
"""What is in memory at a time: pairs of sample and job (300 bytes each; none where a kernel splats), pixels of windows (60 bytes for each
of their planes, transforms among them) and pixels of finished jobs (4 bytes for each plane). Besides, a sample takes 150 bytes, and each
bucket that anything lies in 80 bytes for every tile."""
_UNSEEN = 0.999


@dataclass(frozen=True)
class TorchReconstruction:
    """Reconstruction of clean pictures from few samples, on a device; see LayeredReconstruction, whose settings and pictures these are.

    device: 'cuda', 'cuda:1', 'cpu'. seed: of the choice that the sparse statistics look at.
    Takes the screen filters "windows", "sheared" and "direct".
    """

    settings: Settings = field(default_factory=Settings)
    device: str = "cpu"
    seed: int = 0

    def __post_init__(self) -> None:
        device_named(self.device)

    def reconstruct(self, samples: LightFieldSamples, lens: Lens) -> Layer:
        """Return the picture that more samples would converge to: opaque, with the depth of the nearest sample of each pixel."""
        here = DeviceSamples.of(samples, samples.rgb, samples.coc_px(lens), device_named(self.device))
        picture, _ = self.picture(here, lens.aperture)
        return opaque(picture.cpu().numpy(), _nearest_depth_m(here).cpu().numpy())

    def reconstruct_values(
        self,
        samples: LightFieldSamples,
        values: Float32[np.ndarray, "samples channels"],
        coc_px: Float32[np.ndarray, " samples"],
        aperture: Aperture,
        shared_out: bool = True,
    ) -> tuple[Float32[np.ndarray, "height width channels"], tuple[float, float]]:
        """Reconstruct any values (N, C) from the host; return them and how many partitions a tile has before they are merged and after."""
        here = DeviceSamples.of(samples, values, coc_px, device_named(self.device))
        picture, counts = self.picture(here, aperture, shared_out)
        return picture.cpu().numpy(), counts

    @torch.inference_mode()
    def picture(
        self, samples: DeviceSamples, aperture: Aperture, shared_out: bool = True
    ) -> tuple[Float32[Tensor, "height width channels"], tuple[float, float]]:
        """Return the picture, on the device, and the mean number of partitions of tiles with samples, before they are merged and after.

        shared_out: samples that move are shared out among the four nearest pixels, else all keep the pixel they come into.
        """
        light = tile_light(samples, self.settings)
        every = max(1, round(3 * samples.per_pixel)) if self.settings.sparse_statistics else 1
        rows = tile_rows(light, every, self.seed)
        partitions = partitions_of(rows, light, self.settings)
        slopes = sheared_slopes(partitions.sums, light.window, self.settings.sigma_x_px, self.settings.bandwidth)
        screen = ScreenFilter(self.settings, aperture, light)
        jobs = jobs_of(partitions, slopes, screen.guards(slopes), light, shared_out)
        tiles = max(1, int((jobs.host_counts > 0).sum()))
        return self._composited(light, jobs, screen), (len(rows.tile) / tiles, len(partitions.tile) / tiles)

    def _composited(self, light: TileLight, jobs: Jobs, screen: ScreenFilter) -> Float32[Tensor, "height width channels"]:
        at_once = AT_ONCE[light.values.device.type][2] // light.tile_px**2 // len(screen.shares)
        merges = self.settings.merge and self.settings.part_tolerance > 0.0 and len(screen.shares) > 1
        tiles, left = [], []
        for begin, end in batches(jobs, at_once):
            every = np.arange(begin, end)
            done = self._in_merged_parts(light, jobs, screen, every) if merges else self._in_parts(light, jobs, screen, every)
            tiles.append(done[0])
            left.append(done[1])
        picture = put_together(torch.cat(tiles), light)
        unseen = put_together(torch.cat(left)[:, None], light) >= _UNSEEN
        return torch.where(unseen, own_means(light), picture) if bool(unseen.any()) else picture.contiguous()

    def _in_parts(self, light: TileLight, jobs: Jobs, screen: ScreenFilter, tiles: Int64[np.ndarray, " tiles"]) -> tuple[Tiles, Tensor]:
        """Return pictures of tiles and what is left of each pixel; alone in a tile, a job hides nothing and is whole."""
        counts, members = jobs.host_counts[tiles], jobs_in(jobs, tiles)
        layers = light.values.new_zeros((max(1, len(members)), light.values.shape[1] + 2, len(screen.shares), *(light.tile_px,) * 2))
        is_one_of_many = np.repeat(counts, counts) > 1
        for in_parts in (False, True):
            for to, planes, task, guard in self._planes(light, jobs, members, np.nonzero(is_one_of_many == in_parts)[0]):
                layers[to] = screen.filtered(planes, jobs, task, guard, in_parts)
        return composited(layers, counts, screen.shares)

    def _in_merged_parts(
        self, light: TileLight, jobs: Jobs, screen: ScreenFilter, tiles: Int64[np.ndarray, " tiles"]
    ) -> tuple[Tiles, Tensor]:
        """Return the same, in parts only where these make a difference."""
        counts, members, coarse_px = jobs.host_counts[tiles], jobs_in(jobs, tiles), light.tile_px // COARSE_PX
        planes_and = max(1, len(members)), light.values.shape[1] + 2
        whole = light.values.new_zeros((*planes_and, 1, *(light.tile_px,) * 2))
        alike, apart = (light.values.new_zeros((*planes_and, parts, *(coarse_px,) * 2)) for parts in (1, len(screen.shares)))
        for to, planes, task, guard in self._planes(light, jobs, members, np.arange(len(members))):
            whole[to] = screen.filtered(planes, jobs, task, guard, False)
            alike[to] = screen.filtered_coarse(planes, jobs, task, guard, False)
            apart[to] = screen.filtered_coarse(planes, jobs, task, guard, True)
        picture, left = composited(whole, counts, [1.0])
        without, within = composited(alike, counts, [1.0])[0], composited(apart, counts, screen.shares)[0]
        inside = coarse_inside(light, torch.from_numpy(tiles).to(picture.device))
        is_many = torch.from_numpy(counts > 1).to(picture.device)[:, None, None]
        ratio = torch.where(is_many[..., None], ratio_of(without, within), 1.0)
        box = too_detailed(without, within, inside, self.settings.part_tolerance) & is_many
        picture = scaled_by_coarse(picture, ratio, inside)
        which = torch.nonzero(box.any(dim=2).any(dim=1))[:, 0]
        if len(which):
            in_parts, parts_left = self._in_parts(light, jobs, screen, tiles[which.cpu().numpy()])
            there = fine(box[which])
            picture[which] = torch.where(there[:, None], in_parts, picture[which])
            left[which] = torch.where(there, parts_left, left[which])
        return picture, left

    def _planes(
        self, light: TileLight, jobs: Jobs, members: Int64[np.ndarray, " members"], some: Int64[np.ndarray, " some"]
    ) -> Iterator[tuple[Int64[Tensor, " group"], Tensor, Task, int]]:
        """Yield for some of these jobs, in groups of one guard band: their places among the jobs, reprojected planes, their task, the
        band.
        """
        pairs, pixels, _ = AT_ONCE[light.values.device.type]
        for together, guard in groups(jobs, members[some], light.tile_px, pixels):
            task = task_of(jobs, light, together, guard)
            to = torch.from_numpy(np.searchsorted(members, together)).to(task.job.device)
            yield to, reprojected(jobs, light, task, self.settings.enough, pairs), task, guard


def _nearest_depth_m(samples: DeviceSamples) -> Float32[Tensor, "height width"]:
    x = samples.xy_px[:, 0].long().clamp(max=samples.width_px - 1)
    y = samples.xy_px[:, 1].long().clamp(max=samples.height_px - 1)
    depth_m = torch.full((samples.height_px * samples.width_px,), torch.inf, device=x.device)
    depth_m.scatter_reduce_(0, y * samples.width_px + x, samples.depth_m, "amin")
    return depth_m.view(samples.height_px, samples.width_px)


def composited(
    layers: Float32[Tensor, "jobs planes parts side side"], counts: Int64[np.ndarray, " tiles"], shares: list[float]
) -> tuple[Tiles, Tensor]:
    """Return e(x) = e_0(x) + sum_j e_j(x) prod_{k<j} (1 - alpha_k(x)), and the product over all that is left, (T, side, side).

    Both are the mean over parts of pupil and shutter, by their shares, each of which is composited on its own.
    layers: colour, opacity and weight, both of which the weight divides, of jobs tile by tile; a layer of no weight is not there.
    counts: of jobs, of each tile. Tiles with most jobs go first, so that a step takes only those that still have one.
    """
    order = np.argsort(-counts, kind="stable")
    starts, back = (torch.from_numpy(each).to(layers.device) for each in ((np.cumsum(counts) - counts)[order], np.argsort(order)))
    out = layers.new_zeros((len(counts), layers.shape[1] - 2, *layers.shape[2:]))
    left = torch.ones_like(out[:, 0])
    for rank in range(int(counts.max())):
        active = int((counts > rank).sum())
        layer = layers[starts[:active] + rank]
        weight = layer[:, -1]
        is_there = weight > _LEAST_WEIGHT
        out[:active] += torch.where(is_there, left[:active] / weight, 0.0)[:, None] * layer[:, :-2]
        left[:active] *= torch.where(is_there, (1.0 - layer[:, -2] / weight).clamp(min=0.0), 1.0)
    weights = torch.tensor(shares, dtype=out.dtype, device=out.device)[:, None, None]
    out, left = (out * weights).sum(dim=2), (left * weights).sum(dim=1)
    # Behind the last layer is nothing that was sampled: what no layer claims belongs to those that were seen.
    taken = 1.0 - left
    return torch.where((taken > _LEAST_TAKEN)[:, None], out / taken[:, None], out)[back], left[back]


def put_together(tiles: Tiles, light: TileLight) -> Float32[Tensor, "height width channels"]:
    """Return the picture of all tiles, in rows; the last may be cut."""
    channels, side = tiles.shape[1], light.tile_px
    picture = tiles.view(light.rows, light.columns, channels, side, side).permute(0, 3, 1, 4, 2)
    return picture.reshape(light.rows * side, light.columns * side, channels)[: light.height_px, : light.width_px]


def own_means(light: TileLight) -> Float32[Tensor, "height width channels"]:
    """Return the mean of the samples of each pixel, 0 where it has none."""
    x = light.geometry[:, 0].long().clamp(max=light.width_px - 1)
    y = light.geometry[:, 1].long().clamp(max=light.height_px - 1)
    sums = light.values.new_zeros((light.height_px * light.width_px, light.values.shape[1] + 1))
    sums.index_add_(0, y * light.width_px + x, torch.cat([light.values, torch.ones_like(light.values[:, :1])], dim=1))
    return (sums[:, :-1] / sums[:, -1:].clamp(min=1.0)).view(light.height_px, light.width_px, -1)


def coarse_inside(light: TileLight, tile: Int64[Tensor, " tiles"]) -> Bool[Tensor, "tiles side side"]:
    """Return which coarse pixels of these tiles hold any of the picture."""
    at = torch.arange(light.tile_px // COARSE_PX, device=tile.device) * COARSE_PX
    x, y = (tile % light.columns * light.tile_px)[:, None] + at, (tile // light.columns * light.tile_px)[:, None] + at
    return (y < light.height_px)[:, :, None] & (x < light.width_px)[:, None, :]


def ratio_of(alike: Coarse, apart: Coarse) -> Coarse:
    """Return parts over the whole, from 0 to MOST_RATIO, 1 where the whole is 0."""
    return torch.where(alike == 0.0, 1.0, (apart / torch.where(alike == 0.0, 1.0, alike)).clamp(0.0, MOST_RATIO))


def too_detailed(
    alike: Coarse, apart: Coarse, inside: Bool[Tensor, "tiles side side"], tolerance: float
) -> Bool[Tensor, "tiles side side"]:
    """Return where coarse pixels cannot hold what parts add to the whole: the box around all that were found."""
    mask = inside[:, None].float()
    added = (apart - alike) * mask
    mean = avg_pool2d(added, 3, 1, 1) / avg_pool2d(mask, 3, 1, 1).clamp(min=1e-6)
    dark = DARK * (apart.abs() * mask).sum(dim=(2, 3), keepdim=True) / mask.sum(dim=(2, 3), keepdim=True)
    value = torch.maximum(alike.abs(), apart.abs())
    missed = apart - ratio_of(alike, apart) * alike
    found = (torch.maximum((added - mean).abs(), missed.abs()) > tolerance * (value + dark)).any(dim=1) & inside
    return _between_ends(found.any(dim=2))[:, :, None] & _between_ends(found.any(dim=1))[:, None, :]


def _between_ends(found: Bool[Tensor, "tiles side"]) -> Bool[Tensor, "tiles side"]:
    number = found.int()
    return (torch.cumsum(number, 1) > 0) & (torch.cumsum(number.flip(1), 1).flip(1) > 0)


def fine(box: Bool[Tensor, "tiles side side"]) -> Bool[Tensor, "tiles wide wide"]:
    return box.repeat_interleave(COARSE_PX, dim=1).repeat_interleave(COARSE_PX, dim=2)


def scaled_by_coarse(picture: FineTiles, ratio: Coarse, inside: Bool[Tensor, "tiles side side"]) -> FineTiles:
    """Multiply pictures by coarse pixels, linear between their middles."""
    side = torch.arange(ratio.shape[2], device=ratio.device)
    tile = torch.arange(len(ratio), device=ratio.device)[:, None, None]
    last_y, last_x = (inside.any(dim=axis).sum(dim=1)[:, None] - 1 for axis in (2, 1))
    held = ratio.permute(0, 2, 3, 1)[tile, torch.minimum(side, last_y)[:, :, None], torch.minimum(side, last_x)[:, None, :]]
    return picture * interpolate(held.permute(0, 3, 1, 2), scale_factor=COARSE_PX, mode="bilinear", align_corners=False)
