"""How long layered reconstruction takes by torch.

`python -m tests.bench.bench_torch_reconstruction [--device cuda] [--size 1280x720] [--spp 8]`

The scene after Hasselgren 2015, Fig. 8, with all samples on the device; the compiled renderer reconstructs the same samples in the
same run, and both pictures are compared.
"""

import argparse
import os
import statistics
import time
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import torch

from mrbokeh.images.image_metrics import psnr
from mrbokeh.layering.light_field_samples import LightFieldSamples
from mrbokeh.renderers.layered_reconstruction import LayeredReconstruction, Settings
from mrbokeh.renderers.layered_reconstruction.torch_reconstruction import DeviceSamples, TorchReconstruction
from mrbokeh.system.torch_device import has_triton
from tests.bench.machine import tell, took
from tests.support.sampled_planes import LENS, fence_scene, sample_planes

WAIT_S = 20.0
VARIANTS = {
    "all improvements": Settings(),
    "sheared recursive filter": Settings(screen_filter="sheared"),
    "defocus only": Settings(motion=False),
    "neither merging nor sparse statistics": Settings(merge=False, sparse_statistics=False),
}


def fence_samples(width_px: int, height_px: int, per_pixel: int) -> LightFieldSamples:
    """The scene as large as the longer side, cut to the picture."""
    samples = sample_planes(fence_scene(max(width_px, height_px)), max(width_px, height_px), per_pixel)
    kept = (samples.xy_px < (width_px, height_px)).all(axis=1)
    names = ("xy_px", "lens_uv", "time", "rgb", "depth_m", "motion_px")
    return LightFieldSamples(width_px, height_px, *(np.ascontiguousarray(getattr(samples, name)[kept]) for name in names))


def milliseconds(run: Callable[[], object], device: torch.device) -> float:
    """The median of as many as there is time for, once the first is done."""

    def waited() -> None:
        run()
        if device.type == "cuda":
            torch.cuda.synchronize(device)

    took_ms, until_s = [took(waited).wall_ms], time.perf_counter() + WAIT_S
    while len(took_ms) < 30 and time.perf_counter() < until_s:
        took_ms.append(took(waited).wall_ms)
    return statistics.median(took_ms)


def row(name: str, settings: Settings, samples: LightFieldSamples, on_device: DeviceSamples, device: torch.device) -> None:
    compiled, by_torch = LayeredReconstruction(settings), TorchReconstruction(settings, str(device))
    known, _ = compiled.reconstruct_values(samples, samples.rgb, LENS)
    picture, (before, after) = by_torch.picture(on_device, LENS.aperture)
    found = picture.cpu().numpy()
    if device.type == "cuda":
        torch.cuda.reset_peak_memory_stats(device)
    took_ms = milliseconds(lambda: by_torch.picture(on_device, LENS.aperture), device)
    cpu_ms = milliseconds(lambda: compiled.reconstruct_values(samples, samples.rgb, LENS), torch.device("cpu"))
    memory = f", {torch.cuda.max_memory_allocated(device) / 2**20:.0f} MB of the device" if device.type == "cuda" else ""
    print(f"{name}: {took_ms:.1f} ms; compiled {cpu_ms:.0f} ms, {cpu_ms / took_ms:.2f} times as long{memory}")
    print(
        f"  partitions per tile {before:.1f} -> {after:.1f}; against the compiled renderer {psnr(found, known):.0f} dB, "
        f"largest difference {np.abs(found - known).max():.1e}"
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--device", default="cuda" if torch.cuda.is_available() else "cpu")
    parser.add_argument("--size", default="1280x720", help="width x height in pixels")
    parser.add_argument("--spp", type=int, default=8, help="samples a pixel")
    parser.add_argument("--threads", type=int, default=1, help="of torch where the device is the processor: more wait for one another")
    wanted = parser.parse_args()
    torch.set_num_threads(wanted.threads)
    device = torch.device(wanted.device)
    width_px, height_px = (int(part) for part in wanted.size.split("x"))
    name = torch.cuda.get_device_name(device) if device.type == "cuda" else f"the processor, {torch.get_num_threads()} of its cores"
    by = "Triton kernels" if device.type == "cuda" and has_triton() else "torch alone"
    print(f"device {wanted.device}: {name}; torch {torch.__version__}, by {by}; load before the run {os.getloadavg()[0]:.1f}")
    samples = fence_samples(width_px, height_px, wanted.spp)
    on_device = DeviceSamples.of(samples, samples.rgb, samples.coc_px(LENS), device)
    print(f"{width_px} x {height_px} px, {wanted.spp} spp on the device, {os.cpu_count()} cores for the compiled renderer")
    for variant, settings in VARIANTS.items():
        row(variant, settings, samples, on_device, device)
    row("tiles of 64 px", replace(Settings(), tile_px=64), samples, on_device, device)
    tell()


if __name__ == "__main__":
    main()
