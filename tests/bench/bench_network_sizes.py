"""The paper's Table 2: time and memory of the published network by size of picture and largest circle of confusion.

    python -m tests.bench.bench_network_sizes [--longest-s 5]

On a GPU of torch with its kernels as they are and by Fourier transforms; without one the plain and the fast export by every provider of
ONNX Runtime that is found, each in a process of its own. One tile, fresh weights: the time of the plain form does not depend on them, and
what the fast form gains by factors of trained kernels is not in it. A picture that would take longer than --longest-s is estimated from the
next smaller one.
The paper's numbers (Mandl et al. 2024, Table 2) are of an RTX 4090.
"""

import argparse
import sys
import tempfile
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import torch

from mrbokeh.renderers.onnx_sessions import PROVIDERS, open_session
from tests.bench.device.fourier_network import FourierNetwork
from tests.bench.device.networks import Variant, graph_of, inputs_of, network_of
from tests.bench.machine import in_turns, tell
from tests.bench.process_cost import attempted
from training.networks.network_settings import NetworkSettings

SIZES = {"360p": (640, 360), "720p": (1280, 720), "1080p": (1920, 1080), "1440p": (2560, 1440), "2160p": (3840, 2160)}
PAPER_MS = {
    50.0: {"360p": 15.69, "720p": 15.57, "1080p": 32.34, "1440p": 46.31},
    65.0: {"360p": 31.25, "720p": 31.20, "1080p": 31.24, "1440p": 47.21},
    81.0: {"360p": 31.33, "720p": 38.35, "1080p": 157.5, "1440p": 251.3},
}
CIRCLES_PX = (25.0, *PAPER_MS)
ONE_TILE = NetworkSettings(tile_px=0, overlap_px=0, initialisation="disc")


def alone(path: Path, size: str, provider: str) -> None:
    """Time an exported network in this process, which does nothing else, and print its milliseconds."""
    session = open_session(path, providers=[provider])
    feed = {name: each.numpy() for name, each in zip(("rgb", "coc_px"), inputs_of(SIZES[size], _largest_px(path)), strict=True)}
    print(in_turns(lambda: session.run(["blurred"], feed), repeats=2)[0].wall_ms)


def _largest_px(path: Path) -> float:
    from mrbokeh.renderers.onnx_network import OnnxNetwork

    return OnnxNetwork(path).facts.largest_coc_px


def exported(path: Path, provider: str, longest_s: float) -> Iterator[str]:
    """Yield the cell of each size: milliseconds and megabytes."""
    ms_of_pixel = 0.0
    for size, (width_px, height_px) in SIZES.items():
        expected_s = 1e-3 * ms_of_pixel * width_px * height_px
        if expected_s > longest_s:
            yield f"about {expected_s:.0f} s"
            continue
        cost = attempted([sys.executable, "-m", __spec__.name, "--alone", str(path), size, provider], timeout_s=20.0 * longest_s)
        if cost.exit_code:
            yield f"failed: {cost.last_line[:60]}"
            continue
        ms = float(cost.last_line)
        ms_of_pixel = ms / (width_px * height_px)
        yield f"{ms:.0f} ms, {cost.memory_mb:.0f} MB"


@torch.inference_mode()
def on_gpu(largest_px: float, *, fourier: bool) -> Iterator[str]:
    """Yield the cell of each size by torch, its kernels replayed as one CUDA graph."""
    for size_px in SIZES.values():
        torch.cuda.empty_cache()
        torch.cuda.reset_peak_memory_stats()
        network = network_of(ONE_TILE, size_px, largest_px).to("cuda")
        there = [each.to("cuda") for each in inputs_of(size_px, largest_px)]
        replay = graph_of(FourierNetwork(network, *there[0].shape[2:]) if fourier else network, Variant(graph=True), there)

        def work(replay=replay) -> None:
            replay()
            torch.cuda.synchronize()

        yield f"{in_turns(work, repeats=5)[0].wall_ms:.1f} ms, {torch.cuda.max_memory_allocated() / 2**20:.0f} MB"


def rows_of(largest_px: float, folder: Path, longest_s: float) -> Iterator[tuple[str, Iterator[str]]]:
    """Yield the name of each way of running one network and the cells of its sizes."""
    if torch.cuda.is_available():
        yield f"torch, {torch.cuda.get_device_name(0)}, as it is", on_gpu(largest_px, fourier=False)
        yield f"torch, {torch.cuda.get_device_name(0)}, Fourier transforms", on_gpu(largest_px, fourier=True)
        return
    import onnxruntime

    from tests.bench.bench_network import FACTS
    from training.export.fast_onnx import export_fast_network
    from training.export.onnx_export import export_network

    network, facts = network_of(ONE_TILE, SIZES["360p"], largest_px), replace(FACTS, largest_coc_px=largest_px, radiance_scale=1.0)
    export_network(network, ONE_TILE, facts, folder / "plain.onnx")
    export_fast_network(network, ONE_TILE, facts, folder / "fast.onnx")
    there = [name for name, full in PROVIDERS.items() if full in onnxruntime.get_available_providers()]
    for provider in [*there, "cpu"]:
        for form in ("plain", "fast"):
            yield f"ONNX Runtime, {provider}, {form}", exported(folder / f"{form}.onnx", provider, longest_s)


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--longest-s", type=float, default=5.0, help="of one picture; longer ones are estimated")
    parser.add_argument("--circles", type=float, nargs="*", default=CIRCLES_PX, help="largest circles of confusion in pixels")
    parser.add_argument("--alone", nargs=3, help=argparse.SUPPRESS)
    asked = parser.parse_args()
    if asked.alone is not None:
        alone(Path(asked.alone[0]), *asked.alone[1:])
        return
    print("| largest circle | by | " + " | ".join(SIZES) + " |\n" + "|---" * (len(SIZES) + 2) + "|")
    for largest_px in asked.circles:
        if largest_px in PAPER_MS:
            told = [f"{PAPER_MS[largest_px][size]:g} ms" if size in PAPER_MS[largest_px] else "" for size in SIZES]
            print(f"| {largest_px:g} px | paper, RTX 4090 | {' | '.join(told)} |")
        with tempfile.TemporaryDirectory() as folder:
            for name, cells in rows_of(largest_px, Path(folder), asked.longest_s):
                print(f"| {largest_px:g} px | {name} | {' | '.join(cells)} |", flush=True)
    tell()


if __name__ == "__main__":
    main()
