"""Samples on a device become a picture on the device."""

from dataclasses import dataclass, field

import numpy as np
import torch
from jaxtyping import Float32
from torch import Tensor

from mrbokeh.aperture import Aperture
from mrbokeh.layer import Layer, opaque
from mrbokeh.lens import Lens
from mrbokeh.light_field_samples import LightFieldSamples
from mrbokeh.renderers.layered_reconstruction._settings import Settings
from mrbokeh.renderers.torch_reconstruction._compositing import composited, own_means, put_together
from mrbokeh.renderers.torch_reconstruction._filter import sheared_slopes
from mrbokeh.renderers.torch_reconstruction._jobs import Jobs, batches, groups, jobs_of, task_of
from mrbokeh.renderers.torch_reconstruction._light import TileLight, tile_light
from mrbokeh.renderers.torch_reconstruction._merging import partitions_of
from mrbokeh.renderers.torch_reconstruction._reprojection import reprojected
from mrbokeh.renderers.torch_reconstruction._samples import DeviceSamples
from mrbokeh.renderers.torch_reconstruction._screen import ScreenFilter
from mrbokeh.renderers.torch_reconstruction._statistics import tile_rows
from mrbokeh.torch_device import device_named

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
        starts = np.cumsum([0, *jobs.host_counts]).tolist()
        tiles, left = [], []
        for begin, end in batches(jobs, at_once):
            layers = self._filtered(light, jobs, screen, starts[begin], starts[end])
            done = composited(layers, jobs.host_counts[begin:end], screen.shares)
            tiles.append(done[0])
            left.append(done[1])
        picture = put_together(torch.cat(tiles), light)
        unseen = put_together(torch.cat(left)[:, None], light) >= _UNSEEN
        return torch.where(unseen, own_means(light), picture) if bool(unseen.any()) else picture.contiguous()

    def _filtered(
        self, light: TileLight, jobs: Jobs, screen: ScreenFilter, first: int, end: int
    ) -> Float32[Tensor, "jobs planes parts side side"]:
        """Colour, opacity and weight of some jobs over their tiles, for each part; alone in a tile, a job hides nothing and is whole."""
        pairs, pixels, _ = AT_ONCE[light.values.device.type]
        side = light.tile_px
        layers = light.values.new_zeros((max(1, end - first), light.values.shape[1] + 2, len(screen.shares), side, side))
        is_one_of_many = np.repeat(jobs.host_counts, jobs.host_counts) > 1
        for together, guard in groups(jobs, first, end, side, pixels):
            for in_parts in (False, True):
                members = together[is_one_of_many[together] == in_parts]
                if len(members):
                    task = task_of(jobs, light, members, guard)
                    planes = reprojected(jobs, light, task, self.settings.enough, pairs)
                    layers[task.job - first] = screen.filtered(planes, jobs, task, guard, in_parts)
        return layers


def _nearest_depth_m(samples: DeviceSamples) -> Float32[Tensor, "height width"]:
    x = samples.xy_px[:, 0].long().clamp(max=samples.width_px - 1)
    y = samples.xy_px[:, 1].long().clamp(max=samples.height_px - 1)
    depth_m = torch.full((samples.height_px * samples.width_px,), torch.inf, device=x.device)
    depth_m.scatter_reduce_(0, y * samples.width_px + x, samples.depth_m, "amin")
    return depth_m.view(samples.height_px, samples.width_px)
