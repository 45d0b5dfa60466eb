"""Layered reconstruction on a device, from samples that lie there, against the compiled renderer with the same samples."""

from collections.abc import Iterator
from dataclasses import replace

from mrbokeh.layering.light_field_samples import LightFieldSamples
from mrbokeh.renderers.layered_reconstruction import LayeredReconstruction, Settings
from mrbokeh.renderers.layered_reconstruction.torch_reconstruction import DeviceSamples, TorchReconstruction
from tests.bench.bench_torch_reconstruction import VARIANTS, fence_samples
from tests.bench.device.rows import Row, Run
from tests.support.sampled_planes import LENS

PUBLISHED = "about 5 ms a frame on a GTX 980"
BAR_MS = 5.0
SIZE_PX, SMALL_SIZE_PX, PER_PIXEL = (1280, 720), (96, 54), 4


def rows(run: Run) -> Iterator[Row]:
    width_px, height_px = SMALL_SIZE_PX if run.small else SIZE_PX
    run.tell(f"  sampling the fence scene, {width_px} x {height_px}, {PER_PIXEL} samples a pixel")
    samples = fence_samples(width_px, height_px, PER_PIXEL)
    here = DeviceSamples.of(samples, samples.rgb, samples.coc_px(LENS), run.device)
    for number, (name, settings) in enumerate(VARIANTS.items()):
        run.tell(f"  {name}")
        yield variant_row(run, name, settings, samples, here, is_first=number == 0)


def variant_row(run: Run, name: str, settings: Settings, samples: LightFieldSamples, here: DeviceSamples, is_first: bool) -> Row:
    """Measure one way of reconstructing; the bar is for the first, which has all improvements."""
    compiled, by_torch = LayeredReconstruction(settings), TorchReconstruction(settings, run.name)
    size = f"{samples.width_px} x {samples.height_px}, {PER_PIXEL} spp"
    row = Row(name, size, published=PUBLISHED if is_first else "", bar_ms=BAR_MS if is_first else None)
    row = run.measured(row, lambda: by_torch.picture(here, LENS.aperture), lambda: by_torch.reconstruct(samples, LENS))
    found, (before, after) = by_torch.picture(here, LENS.aperture)
    run.tell(f"  {name}: the compiled renderer")
    row = row.by_processor(lambda: compiled.reconstruct_values(samples, samples.rgb, LENS), run, most_s=4.0)
    known, _ = compiled.reconstruct_values(samples, samples.rgb, LENS)
    return replace(row.compared(found, known), note=f"partitions of a tile {before:.1f} -> {after:.1f}")
