"""How long the networks take: `python -m tests.bench_network`.

One training step and one picture of 576x384 px with circles of confusion up to 13 px, by PyTorch and by ONNX Runtime;
the yardstick is OpenCV's Gaussian blur of the same picture at the size of the largest circle of confusion.
"""

import tempfile
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import torch

from mrbokeh.lens import Lens
from mrbokeh.renderers.onnx_network import OnnxNetwork
from tests.machine import machine_line, memory_line
from training.export_onnx import export_network
from training.network_settings import NetworkSettings
from training.presets import demo_settings
from training.run_folder import RunFacts, build_network
from training.settings import TrainSettings

HEIGHT_PX, WIDTH_PX, LARGEST_COC_PX = 384, 576, 13.0
FACTS = RunFacts(Lens(35.0, 2.8, 1.0, 23.5), WIDTH_PX, HEIGHT_PX, LARGEST_COC_PX, 20.0, (), (), None)
FORMS = {
    "published, 200 px tiles": NetworkSettings(),
    "published, one tile": NetworkSettings(tile_px=0, overlap_px=0),
    "gated, demo preset": demo_settings().network,
    "gated, 200 px tiles": replace(demo_settings().network, tile_px=200, overlap_px=60),
}


def _milliseconds(run: Callable[[], object], repeats: int = 3) -> float:
    run()
    started_s = time.perf_counter()
    for _ in range(repeats):
        run()
    return 1e3 * (time.perf_counter() - started_s) / repeats


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


def main() -> None:
    print(f"{WIDTH_PX}x{HEIGHT_PX} px, circles of confusion up to {LARGEST_COC_PX:g} px, {torch.get_num_threads()} threads")
    picture = np.ascontiguousarray(_slanted_scene()[0][0].permute(1, 2, 0).numpy())
    yardstick_ms = _milliseconds(lambda: cv2.GaussianBlur(picture, (0, 0), LARGEST_COC_PX / 4), repeats=30)
    print(f"yardstick, OpenCV Gaussian blur: {yardstick_ms:.2f} ms")
    print("| network | parameters | training step ms | PyTorch ms | ONNX Runtime ms | over yardstick |\n|---|---|---|---|---|---|")
    for name, settings in FORMS.items():
        count = sum(each.numel() for each in build_network(TrainSettings(network=settings), FACTS).parameters())
        step, plain, exported = _times_ms(settings)
        print(f"| {name} | {count} | {step:.0f} | {plain:.0f} | {exported:.0f} | {exported / yardstick_ms:.0f} |")
    print(memory_line())
    print(machine_line())


if __name__ == "__main__":
    main()
