"""Samples on a device become a picture on the device."""

from collections.abc import Iterator
from dataclasses import dataclass, field

import numpy as np
import torch
from jaxtyping import Float32, Int64
from torch import Tensor

from mrbokeh.images.layer import Layer, opaque
from mrbokeh.layering.light_field_samples import LightFieldSamples
from mrbokeh.optics.aperture import Aperture
from mrbokeh.optics.lens import Lens
from mrbokeh.renderers.layered_reconstruction._parts_numba import COARSE_PX
from mrbokeh.renderers.layered_reconstruction._settings import Settings
from mrbokeh.renderers.layered_reconstruction.torch_reconstruction._compositing import Tiles, composited, own_means, put_together
from mrbokeh.renderers.layered_reconstruction.torch_reconstruction._filter import sheared_slopes
from mrbokeh.renderers.layered_reconstruction.torch_reconstruction._jobs import Jobs, Task, batches, groups, jobs_in, jobs_of, task_of
from mrbokeh.renderers.layered_reconstruction.torch_reconstruction._light import TileLight, tile_light
from mrbokeh.renderers.layered_reconstruction.torch_reconstruction._merging import partitions_of
from mrbokeh.renderers.layered_reconstruction.torch_reconstruction._parts import (
    coarse_inside,
    fine,
    ratio_of,
    scaled_by_coarse,
    too_detailed,
)
from mrbokeh.renderers.layered_reconstruction.torch_reconstruction._reprojection import reprojected
from mrbokeh.renderers.layered_reconstruction.torch_reconstruction._samples import DeviceSamples
from mrbokeh.renderers.layered_reconstruction.torch_reconstruction._screen import ScreenFilter
from mrbokeh.renderers.layered_reconstruction.torch_reconstruction._statistics import tile_rows
from mrbokeh.system.torch_device import device_named

AT_ONCE = {"cpu": (1 << 15, 1 << 17, 1 << 22), "cuda": (1 << 22, 1 << 23, 1 << 26)}
"""What is in memory at a time: pairs of sample and job (300 bytes each; none where a kernel splats), pixels of windows (60 bytes for each
of their planes, transforms among them) and pixels of finished jobs (4 bytes for each plane). Besides, a sample takes 150 bytes, and each
bucket that anything lies in 80 bytes for every tile."""

_UNSEEN = 0.999


@dataclass(frozen=True)
class TorchReconstruction:
    """Clean pictures from few samples, on a device; see LayeredReconstruction, whose settings and pictures these are.

    device: 'cuda', 'cuda:1', 'cpu'. seed: of the choice that the sparse statistics look at.
    Takes the screen filters "windows", "sheared" and "direct".
    """

    settings: Settings = field(default_factory=Settings)
    device: str = "cpu"
    seed: int = 0

    def __post_init__(self) -> None:
        device_named(self.device)

    def reconstruct(self, samples: LightFieldSamples, lens: Lens) -> Layer:
        """The picture that more samples would converge to: opaque, with the depth of the nearest sample of each pixel."""
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
        """Any values (N, C) from the host and back, and how many partitions a tile has before they are merged and after."""
        here = DeviceSamples.of(samples, values, coc_px, device_named(self.device))
        picture, counts = self.picture(here, aperture, shared_out)
        return picture.cpu().numpy(), counts

    @torch.inference_mode()
    def picture(
        self, samples: DeviceSamples, aperture: Aperture, shared_out: bool = True
    ) -> tuple[Float32[Tensor, "height width channels"], tuple[float, float]]:
        """The picture, on the device, and the mean number of partitions of tiles with samples, before they are merged and after.

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
        """Pictures of tiles and what is left of each pixel; alone in a tile, a job hides nothing and is whole."""
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
        """The same, in parts only where these make a difference."""
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
        """Of some of these jobs, in groups of one guard band: their places among them, reprojected planes, what they are, the band."""
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
