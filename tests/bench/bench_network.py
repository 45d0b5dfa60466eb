"""How long the networks take: `python -m tests.bench.bench_network`.

One training step and one picture of 576x384 px with circles of confusion up to 13 px, by PyTorch and by ONNX Runtime;
the yardstick is OpenCV's Gaussian blur of the same picture at the size of the largest circle of confusion.

Then the plain and the fast export of networks with N = 25 at 640x360 px, in turns, with every circle of confusion in the picture
(`--only fast` skips the rest). `--run RUN [--data SCENES]` takes a trained run, with the loss against the truth; without one the networks
are fresh: discs for the gated form, and for the published form PyTorch's noise, which no factorisation makes smaller, so that what
is measured there is the layout alone.
"""

import argparse
import statistics
import tempfile
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import torch
from torch.nn import functional

from mrbokeh.optics.lens import Lens
from mrbokeh.renderers.onnx_network import OnnxNetwork
from mrbokeh.renderers.onnx_sessions import PROVIDERS, open_session
from tests.bench.machine import in_turns, tell
from training.export.fast_onnx import FastExported, export_fast_network, export_fast_run
from training.export.onnx_export import export_network
from training.fitting.run_folder import RunFacts, build_network
from training.fitting.settings import TrainSettings, demo_settings
from training.networks.kernels import depthwise
from training.networks.network_settings import NetworkSettings

HEIGHT_PX, WIDTH_PX, LARGEST_COC_PX = 384, 576, 13.0
FACTS = RunFacts(Lens(35.0, 2.8, 1.0, 23.5), WIDTH_PX, HEIGHT_PX, LARGEST_COC_PX, 20.0, (), (), None)
FORMS = {
    "published, 200 px tiles": NetworkSettings(),
    "published, one tile": NetworkSettings(tile_px=0, overlap_px=0),
    "gated, demo preset": demo_settings().network,
    "gated, 200 px tiles": replace(demo_settings().network, tile_px=200, overlap_px=60),
}
FAST_FACTS = replace(FACTS, width_px=640, height_px=360)
FAST_FORMS = {
    "gated, demo preset, N = 25": (demo_settings().network, replace(FAST_FACTS, largest_coc_px=49.0)),
    "published, one tile, N = 25": (NetworkSettings(tile_px=0, overlap_px=0, blocks=25), replace(FAST_FACTS, largest_coc_px=51.0)),
    "published, 15 tiles of 200 px, N = 25": (NetworkSettings(blocks=25), replace(FAST_FACTS, largest_coc_px=51.0)),
}


def _milliseconds(run: Callable[[], object], repeats: int = 3) -> float:
    return in_turns(run, repeats=repeats, of=statistics.fmean)[0].wall_ms


def _slanted_scene() -> tuple[torch.Tensor, torch.Tensor]:
    rgb = torch.rand(1, 3, HEIGHT_PX, WIDTH_PX, generator=torch.Generator().manual_seed(0))
    return rgb, torch.linspace(-LARGEST_COC_PX, LARGEST_COC_PX, WIDTH_PX).expand(1, 1, HEIGHT_PX, WIDTH_PX).contiguous()


def _times_ms(settings: NetworkSettings) -> tuple[float, float, float]:
    """(training step, PyTorch, ONNX Runtime)."""
    network, (rgb, coc_px) = build_network(TrainSettings(network=settings), FACTS), _slanted_scene()
    step = _milliseconds(lambda: network(rgb, coc_px).square().mean().backward())
    with torch.no_grad(), tempfile.TemporaryDirectory() as folder:
        plain = _milliseconds(lambda: network(rgb, coc_px))
        export_network(network, settings, FACTS, Path(folder) / "lens.onnx")
        exported = OnnxNetwork(Path(folder) / "lens.onnx")
        picture, blur = np.ascontiguousarray(rgb[0].permute(1, 2, 0).numpy()), coc_px[0, 0].numpy()
        return step, plain, _milliseconds(lambda: exported.blur(picture, blur))


def _fast_row(name: str, done: FastExported, yardstick_ms: float, on_devices: str) -> str:
    times = f"{done.naive_ms:.0f} | {done.fast_ms:.0f} | {done.naive_ms / done.fast_ms:.1f} | {done.fast_ms / yardstick_ms:.0f}"
    return f"| {name} | {times} | {done.loss_db:.3f} | {on_devices} | {done.plan.words()} |"


def _on_devices(path: Path) -> str:
    """Milliseconds of an exported network on each GPU provider that there is."""
    import onnxruntime

    facts, times = OnnxNetwork(path).facts, []
    ramp = np.linspace(-facts.largest_coc_px, facts.largest_coc_px, 640, dtype=np.float32)
    feed = {"rgb": np.full((1, 3, 360, 640), 0.5, np.float32), "coc_px": np.ascontiguousarray(np.broadcast_to(ramp, (1, 1, 360, 640)))}
    for provider in (name for name, full in PROVIDERS.items() if full in onnxruntime.get_available_providers()):
        session = open_session(path, providers=[provider])
        times.append(f"{provider} {_milliseconds(lambda session=session: session.run(['blurred'], feed), 10):.1f}")
    return ", ".join(times) or "no GPU"


def _fast_table(run: Path | None, data: list[Path], part_of_name: str) -> None:
    picture = np.random.default_rng(0).random((360, 640, 3), dtype=np.float32)
    yardstick_ms = _milliseconds(lambda: cv2.GaussianBlur(picture, (0, 0), 49.0 / 4), repeats=30)
    print(f"640x360 px, yardstick (OpenCV Gaussian of 49 px): {yardstick_ms:.2f} ms, budget 0.2 dB")
    print(
        "| network | plain ms | fast ms | times faster | fast over yardstick | loss dB | GPU ms | plan |\n|---|---|---|---|---|---|---|---|"
    )
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "fast.onnx"
        if run is not None:
            print(_fast_row(run.name, export_fast_run(run, path, scenes=data), yardstick_ms, _on_devices(path)))
        chosen = {name: form for name, form in FAST_FORMS.items() if run is None and part_of_name in name}
        for name, (settings, facts) in chosen.items():
            network = build_network(TrainSettings(network=settings), facts)
            print(_fast_row(name, export_fast_network(network.eval(), settings, facts, path), yardstick_ms, _on_devices(path)), flush=True)


def _training_table() -> None:
    print(f"{WIDTH_PX}x{HEIGHT_PX} px, circles of confusion up to {LARGEST_COC_PX:g} px, {torch.get_num_threads()} threads")
    picture = np.ascontiguousarray(_slanted_scene()[0][0].permute(1, 2, 0).numpy())
    yardstick_ms = _milliseconds(lambda: cv2.GaussianBlur(picture, (0, 0), LARGEST_COC_PX / 4), repeats=30)
    print(f"yardstick, OpenCV Gaussian blur: {yardstick_ms:.2f} ms")
    print("| network | parameters | training step ms | PyTorch ms | ONNX Runtime ms | over yardstick |\n|---|---|---|---|---|---|")
    for name, settings in FORMS.items():
        count = sum(each.numel() for each in build_network(TrainSettings(network=settings), FACTS).parameters())
        step, plain, exported = _times_ms(settings)
        print(f"| {name} | {count} | {step:.0f} | {plain:.0f} | {exported:.0f} | {exported / yardstick_ms:.0f} |")
    maps, kernels = torch.rand(1, 4, 64, 64).contiguous(memory_format=torch.channels_last), torch.rand(4, 1, 25, 25, requires_grad=True)
    ours, pytorchs = (
        _milliseconds(lambda convolve=convolve: torch.autograd.grad(convolve().sum(), kernels))
        for convolve in (lambda: depthwise(maps, kernels, None, 12), lambda: functional.conv2d(maps, kernels, padding=12, groups=4))
    )
    print(f"learning 4 kernels of 25 x 25: {ours:.1f} ms, by PyTorch's own gradient {pytorchs:.1f} ms, {pytorchs / ours:.0f} times as long")


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--only", choices=["fast"], help="leave the training steps out")
    parser.add_argument("--run", type=Path, help="a trained run instead of fresh networks")
    parser.add_argument("--data", type=Path, nargs="*", default=[], help="focal stacks with the truth")
    parser.add_argument("--form", default="", help="of the fast ones those with this in their name")
    asked = parser.parse_args()
    if asked.only is None and asked.run is None:
        _training_table()
    _fast_table(asked.run, asked.data, asked.form)
    tell()


if __name__ == "__main__":
    main()
