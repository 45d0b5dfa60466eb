"""Layered reconstruction of defocus and motion blur from few samples of the light field.

Munkberg et al. 2014 with the improvements of Hasselgren et al. 2015; docs/methods/layered_reconstruction.md derives the filter.

1. Samples are sorted into tiles, depth buckets and cells of motion; buckets of a tile with like filters become one partition, and
   those that can hardly be seen join one.
2. Mean and variance of the blur and of the motion of a partition give its sheared filter.
3. The samples around the tile are reprojected to the middle of pupil and shutter along the partition's slopes. Those of the
   partition add colour and opacity, those behind it lower the opacity, for they were seen through it.
4. A filter over the screen spreads what the reprojection took together, part by part of pupil and shutter.
5. Partitions are composited front to back, for each part on its own; the picture is the mean of the parts. Where parts make no
   difference, as pixels four times as large show, they are merged.
"""

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from jaxtyping import Float32

from mrbokeh.images.layer import Layer, flatten, opaque
from mrbokeh.layering.light_field_samples import LightFieldSamples
from mrbokeh.optics.aperture import Aperture
from mrbokeh.optics.lens import Lens
from mrbokeh.renderers.layered_reconstruction._samples import all_sharp, prepared, sample_layers
from mrbokeh.renderers.layered_reconstruction._settings import SCREEN_FILTERS, Settings, footprint_sigmas
from mrbokeh.renderers.layered_reconstruction._tile_data import BLOCKS, Choice, Pupil, packed_pupil
from mrbokeh.system.errors import InputError
from mrbokeh.system.resources import cores

__all__ = ["SCREEN_FILTERS", "LayeredReconstruction", "PartitionCounts", "Settings", "footprint_sigmas"]

_TILES_AT_ONCE = 8
_KINDS = {"direct": 0, "sheared": 1, "texture": 2, "texture_one_tap": 3, "windows": 4}


@dataclass(frozen=True)
class PartitionCounts:
    """Mean number of partitions per tile before layers are merged and after."""

    before: float
    after: float


_BYTES_PER_SAMPLE = 180
"""Measured: 4.3 GB at 750x500 pixels with 64 samples each."""


def _require_memory(size_px: tuple[int, ...], per_pixel: int) -> None:
    """Raise InputError where samples of a picture (height, width) do not fit into the memory that is free, as far as the system tells."""
    needed_gb, free_gb = size_px[0] * size_px[1] * per_pixel * _BYTES_PER_SAMPLE / 1e9, float("inf")
    with suppress(OSError, ValueError, IndexError):
        free_gb = int(Path("/proc/meminfo").read_text().split("MemAvailable:")[1].split()[0]) / 1e6
    if needed_gb > free_gb:
        raise InputError(
            f"layered reconstruction of {size_px[1]}x{size_px[0]} px takes about {needed_gb:.0f} GB of memory, {free_gb:.0f} GB are free: "
            f"render a smaller picture, or take another renderer"
        )


@dataclass(frozen=True)
class LayeredReconstruction:
    """Reconstruction of clean pictures from few samples, and a Renderer that takes samples of layers first.

    per_pixel: how many samples of layers are taken a pixel. threads: 0 takes all cores. seed: of these samples and of the choice
    that the sparse statistics look at. device: "" for compiled loops; "cuda", "cuda:1" or "cpu" for torch there, without the
    texture filter (mrbokeh.renderers.layered_reconstruction.torch_reconstruction).
    """

    settings: Settings = field(default_factory=Settings)
    per_pixel: int = 64
    threads: int = 0
    seed: int = 0
    device: str = ""

    def __post_init__(self) -> None:
        if self.device:
            from mrbokeh.renderers.layered_reconstruction.torch_reconstruction import TorchReconstruction

            TorchReconstruction(self.settings, self.device, self.seed)  # refuses what is not there

    def render(self, layers: Sequence[Layer], lens: Lens) -> Layer:
        """Render layers (see Renderer). Extra channels `motion_px` (mrbokeh.layering.motion) blur as well.

        Takes openings that are the same over the frame and for all colours; InputError for cat-eyes and chromatic errors.
        """
        flat, aperture = flatten(layers), lens.aperture
        _require_memory(flat.alpha.shape, self.per_pixel)
        if aperture.varies_over_field or aperture.is_chromatic:
            raise InputError(
                "layered reconstruction takes openings that are the same over the frame and for all colours: leave out rims, set cat_eye, "
                "axial_chromatic and lateral_chromatic to 0, or take another renderer"
            )
        if all_sharp(layers, lens):
            return flat
        samples, values, coc_px, margin = sample_layers(layers, lens, self.per_pixel, self.seed, self.threads)
        without_noise = replace(self, settings=replace(self.settings, part_tolerance=0.0))  # nothing hides what merged parts leave out
        spread, _ = without_noise._reconstructed(samples, values, coc_px, lens.aperture, shared_out=False)
        inside = np.ascontiguousarray(spread[margin : margin + flat.height_px, margin : margin + flat.width_px])
        extra, start = {}, 4
        for name, plane in layers[0].extra.items():
            extra[name] = inside[..., start : start + plane.shape[2]].copy()
            start += plane.shape[2]
        return Layer(inside[..., :3].copy(), np.clip(inside[..., 3], 0.0, 1.0), flat.depth_m, extra)

    def reconstruct(self, samples: LightFieldSamples, lens: Lens) -> Layer:
        """Return the picture that more samples would converge to: opaque, with the depth of the nearest sample of each pixel."""
        rgb, _ = self.reconstruct_values(samples, samples.rgb, lens)
        return opaque(rgb, _nearest_depth_m(samples))

    def reconstruct_values(
        self, samples: LightFieldSamples, values: Float32[np.ndarray, "samples channels"], lens: Lens
    ) -> tuple[Float32[np.ndarray, "height width channels"], PartitionCounts]:
        """Reconstruct any values (N, C) in place of the samples' colour."""
        return self._reconstructed(samples, values, samples.coc_px(lens), lens.aperture)

    def _reconstructed(
        self,
        samples: LightFieldSamples,
        values: Float32[np.ndarray, "samples channels"],
        coc_px: Float32[np.ndarray, " samples"],
        aperture: Aperture,
        shared_out: bool = True,
    ) -> tuple[Float32[np.ndarray, "height width channels"], PartitionCounts]:
        if self.device:
            from mrbokeh.renderers.layered_reconstruction.torch_reconstruction import TorchReconstruction

            on_device = TorchReconstruction(self.settings, self.device, self.seed)
            found, both = on_device.reconstruct_values(samples, values, coc_px, aperture, shared_out)
            return found, PartitionCounts(*both)
        from mrbokeh.renderers.layered_reconstruction._tiles_numba import reconstruct_tiles

        light = prepared(samples, values, coc_px, self.settings)
        choice = self._choice(samples.per_pixel, shared_out)
        pupil, cells = (Pupil(*packed_pupil(aperture, across)) for across in (1, self.settings.parts[0]))
        tiles = (len(light.starts) - 1) // BLOCKS
        counts = np.zeros((tiles, 2), np.int32)
        out = np.zeros((samples.height_px, samples.width_px, values.shape[1]), np.float32)

        def run(part: np.ndarray) -> None:
            reconstruct_tiles(out, part, counts, light, choice, pupil, cells, light.depths * light.cells)

        self._each(run, tiles)
        before, after = counts[counts[:, 0] > 0].mean(axis=0)
        return out, PartitionCounts(float(before), float(after))

    def _choice(self, per_pixel: float, shared_out: bool = True) -> Choice:
        chosen = self.settings
        every = max(1, round(3 * per_pixel)) if chosen.sparse_statistics else 1
        return Choice(
            every=every,
            seed=self.seed,
            merge=chosen.merge,
            tolerance=chosen.merge_tolerance,
            sigma_x_px=chosen.sigma_x_px,
            bandwidth=chosen.bandwidth,
            kind=_KINDS[chosen.screen_filter],
            support=chosen.support,
            passes=chosen.recursive_passes,
            alpha=footprint_sigmas(chosen.energy),
            tap_distance=chosen.tap_distance,
            enough=chosen.enough,
            shared_out=shared_out,
            times=chosen.parts[1],
            part_tolerance=chosen.part_tolerance if chosen.merge else 0.0,
            faint=chosen.faint if chosen.merge else 0.0,
        )

    def _each(self, run: Callable[[np.ndarray], None], tiles: int) -> None:
        """Run tiles in groups; none touches another's pixels, so that their order and the number of threads change nothing."""
        groups = [np.arange(first, min(first + _TILES_AT_ONCE, tiles)) for first in range(0, tiles, _TILES_AT_ONCE)]
        with ThreadPoolExecutor(self.threads or cores()) as pool:
            list(pool.map(run, groups))


def _nearest_depth_m(samples: LightFieldSamples) -> Float32[np.ndarray, "height width"]:
    depth_m = np.full((samples.height_px, samples.width_px), np.inf, np.float32)
    x, y = samples.pixels()
    np.minimum.at(depth_m, (y, x), samples.depth_m)
    return depth_m
