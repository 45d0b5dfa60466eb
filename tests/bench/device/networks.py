"""The published network on a device at 1920 x 1080: precisions, layouts, replayed graphs and what torch.compile makes of it.

Fresh weights: the time does not depend on them. Half precision is compared with single precision on the device; single precision with the
processor on a smaller picture, as a whole one would take the processor minutes.
"""

from collections.abc import Callable, Iterator
from contextlib import nullcontext
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor

from mrbokeh.optics.lens import Lens
from tests.bench.device.fourier_network import FourierNetwork
from tests.bench.device.rows import Row, Run, in_short, threads_of_torch
from training.fitting.run_folder import RunFacts, build_network
from training.fitting.settings import TrainSettings
from training.networks.network import BlurNetwork
from training.networks.network_settings import NetworkSettings

PUBLISHED = "157.5 ms at 1080p on an RTX 4090"
BARS_MS = {65.0: 20.0, 81.0: 30.0}
SIZE_PX, SMALL_SIZE_PX, COMPARED_PX = (1920, 1080), (96, 54), (480, 270)
SMALL_COC_PX = 9.0
ONE_TILE, TILES = NetworkSettings(tile_px=0, overlap_px=0), NetworkSettings()


@dataclass(frozen=True)
class Variant:
    """A way of running the network.

    half: the type that autocast takes. channels_last: the channels of a pixel lie side by side. graph: a captured CUDA graph is replayed.
    fourier: wide kernels by transforms (`fourier_network`).
    """

    half: torch.dtype | None = None
    channels_last: bool = False
    graph: bool = False
    compiled: bool = False
    fourier: bool = False


VARIANTS = {
    "float32": Variant(),
    "float32, channels last": Variant(channels_last=True),
    "float32, graph replayed": Variant(graph=True),
    "float32, Fourier transforms": Variant(fourier=True),
    "float32, Fourier transforms, graph replayed": Variant(fourier=True, graph=True),
    "float16 autocast": Variant(half=torch.float16),
    "float16 autocast, channels last": Variant(half=torch.float16, channels_last=True),
    "float16 autocast, graph replayed": Variant(half=torch.float16, graph=True),
}
COMPILED = {
    "float32, torch.compile": Variant(compiled=True),
    "float16 autocast, torch.compile": Variant(half=torch.float16, compiled=True),
}


def network_of(settings: NetworkSettings, size_px: tuple[int, int], largest_px: float) -> BlurNetwork:
    facts = RunFacts(Lens(35.0, 2.8, 1.0, 23.5), *size_px, largest_px, 1.0, (), (), None)
    return build_network(TrainSettings(network=settings), facts).eval()


def inputs_of(size_px: tuple[int, int], largest_px: float) -> tuple[Tensor, Tensor]:
    """Return a picture of noise and circles of confusion that rise from left to right."""
    width_px, height_px = size_px
    rgb = torch.rand(1, 3, height_px, width_px, generator=torch.Generator().manual_seed(0))
    return rgb, torch.linspace(-largest_px, largest_px, width_px).expand(1, 1, height_px, width_px).contiguous()


def rows(run: Run) -> Iterator[Row]:
    sizes = {SMALL_COC_PX: None} if run.small else BARS_MS
    for largest_px in sizes:
        yield compared_row(run, largest_px)
        yield from size_rows(run, largest_px)
    for largest_px in sizes:
        yield tiles_row(run, largest_px)
    if not run.small:
        yield from compiled_rows(run, min(sizes))


@torch.inference_mode()
def compared_row(run: Run, largest_px: float) -> Row:
    """Measure a smaller picture on both, and compare."""
    size_px = SMALL_SIZE_PX if run.small else COMPARED_PX
    run.tell(f"  a picture of {size_px[0]} x {size_px[1]} on both, circles up to {largest_px:g} px")
    network, host = network_of(ONE_TILE, size_px, largest_px), inputs_of(size_px, largest_px)
    row = Row(f"one tile, circles up to {largest_px:g} px, float32, compared with the processor", f"{size_px[0]} x {size_px[1]}")
    with threads_of_torch(run.cores):
        row, known = row.by_processor(lambda: network(*host), run, most_s=4.0), network(*host)
    network, there = network.to(run.device), [each.to(run.device) for each in host]
    return run.measured(row, lambda: network(*there)).compared(network(*there), known)


@torch.inference_mode()
def size_rows(run: Run, largest_px: float) -> Iterator[Row]:
    """Measure a whole picture in every variant; a variant that fails does not hide the others."""
    size_px = SMALL_SIZE_PX if run.small else SIZE_PX
    network, host = network_of(ONE_TILE, size_px, largest_px).to(run.device), inputs_of(size_px, largest_px)
    there = [each.to(run.device) for each in host]
    known: Tensor | None = None
    for name, variant in VARIANTS.items():
        if variant.graph and run.device.type != "cuda":
            continue
        row = Row(f"one tile, circles up to {largest_px:g} px, {name}", f"{size_px[0]} x {size_px[1]}", published=PUBLISHED)
        row = replace(row, bar_ms=BARS_MS.get(largest_px))
        row, found = tried(run, row, network, variant, there, host)
        known = found if known is None else known
        yield row if found is None or found is known or known is None else row.compared(found, known)


def tried(
    run: Run, row: Row, network: BlurNetwork, variant: Variant, there: list[Tensor], host: tuple[Tensor, Tensor] | None
) -> tuple[Row, Tensor | None]:
    """Return the measured row and the picture; or the row with what went wrong, and None."""
    run.tell(f"  {row.name}")
    network.tiles.channels_last = variant.channels_last  # type: ignore[assignment]
    try:
        called: Callable[..., Tensor] = FourierNetwork(network, *there[0].shape[2:]) if variant.fourier else network
        work = graph_of(called, variant, there) if variant.graph else plain(called, variant, there)
        found = work().clone()
        copied = None if host is None or variant.graph else transfers(called, variant, host, run)
        return run.measured(row, work, copied, most_s=1.0), found
    except Exception as error:
        return replace(row, note=in_short(error)), None


def cast(device: torch.device, variant: Variant) -> Any:
    """Return the context that computes in the variant's type."""
    return nullcontext() if variant.half is None else torch.autocast(device.type, variant.half)


def plain(network: Callable[..., Tensor], variant: Variant, there: list[Tensor]) -> Callable[[], Tensor]:
    """Return what runs the network on tensors of the device, compiled if the variant is."""
    called = torch.compile(network) if variant.compiled else network

    def work() -> Tensor:
        with cast(there[0].device, variant):
            return called(*there)

    return work


def transfers(network: Callable[..., Tensor], variant: Variant, host: tuple[Tensor, Tensor], run: Run) -> Callable[[], Tensor]:
    """Return what copies the inputs there, runs the network and copies the picture back."""

    def work() -> Tensor:
        with cast(run.device, variant):
            return network(*(each.to(run.device) for each in host)).cpu()

    return work


def graph_of(network: Callable[..., Tensor], variant: Variant, there: list[Tensor]) -> Callable[[], Tensor]:
    """Capture the network as a CUDA graph and return what replays it; autocast's copies of weights may not outlive the capture."""
    half = variant.half or torch.float16
    stream = torch.cuda.Stream()
    stream.wait_stream(torch.cuda.current_stream())
    graph = torch.cuda.CUDAGraph()
    with torch.autocast("cuda", half, enabled=variant.half is not None, cache_enabled=False):
        with torch.cuda.stream(stream):
            for _ in range(3):
                network(*there)
        torch.cuda.current_stream().wait_stream(stream)
        with torch.cuda.graph(graph):
            picture = network(*there)

    def work() -> Tensor:
        graph.replay()
        return picture

    return work


@torch.inference_mode()
def tiles_row(run: Run, largest_px: float) -> Row:
    """Measure the network in tiles of 200 px, as published."""
    size_px = SMALL_SIZE_PX if run.small else SIZE_PX
    network = network_of(TILES, size_px, largest_px).to(run.device)
    there = [each.to(run.device) for each in inputs_of(size_px, largest_px)]
    row = Row(f"tiles of 200 px, circles up to {largest_px:g} px, float16 autocast", f"{size_px[0]} x {size_px[1]}", published=PUBLISHED)
    return tried(run, row, network, Variant(half=torch.float16), there, None)[0]


def compiled_rows(run: Run, largest_px: float) -> Iterator[Row]:
    """Measure what torch.compile makes of it, last because it may take the rest of the time."""
    network = network_of(ONE_TILE, SIZE_PX, largest_px).to(run.device)
    there = [each.to(run.device) for each in inputs_of(SIZE_PX, largest_px)]
    with torch.no_grad():
        for name, variant in COMPILED.items():
            row = Row(f"one tile, circles up to {largest_px:g} px, {name}", f"{SIZE_PX[0]} x {SIZE_PX[1]}", published=PUBLISHED)
            yield tried(run, replace(row, bar_ms=BARS_MS[largest_px]), network, variant, there, None)[0]
