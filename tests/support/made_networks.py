"""Small networks that are not trained, with weights that matter everywhere, and what PyTorch and ONNX Runtime make of a picture."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import onnxruntime
import torch
from onnx import ModelProto

from mrbokeh.optics.camera import field_positions
from training.export.gated_graph import gated_model
from training.export.gated_weights import thinned, weights_of
from training.fitting.settings import demo_settings
from training.networks.network import BlurNetwork, TileGrid
from training.networks.network_settings import NetworkSettings

LARGEST_PX, TOP = 11.0, 4.0
SIZE = (41, 58)
GATED = replace(demo_settings().network, hidden=8)
PUBLISHED = NetworkSettings(tile_px=0, overlap_px=0, blocks=4, initialisation="disc")
PARITY = 1e-4  # what the plain export is held to as well


def untrained(settings: NetworkSettings, largest_px: float = LARGEST_PX, grid: TileGrid | None = None) -> BlurNetwork:
    """Not trained, but with weights that matter everywhere."""
    torch.manual_seed(1)
    network = BlurNetwork(settings, largest_px, TOP, grid, ((2.0, 8.0), (24.0, 70.0)) if settings.lens_inputs else None)
    with torch.no_grad():
        for name, parameter in network.named_parameters():
            if "hide" in name or "mixing" in name:
                parameter.normal_(0.0, 0.3)
    return network.eval()


@torch.no_grad()
def jittered(network: BlurNetwork, std: float, seed: int = 0) -> BlurNetwork:
    """Away from its start, as training might leave it."""
    generator = torch.Generator().manual_seed(seed)
    for parameter in network.parameters():
        parameter.add_(std * torch.randn(parameter.shape, generator=generator))
    return network


def pictures(size: tuple[int, int] = SIZE, largest_px: float = LARGEST_PX) -> dict[str, torch.Tensor]:
    rng = np.random.default_rng(3)
    rgb = rng.random((1, 3, *size), dtype=np.float32)
    rgb[:, :, 7::16, 5::16] = TOP
    coc_px = (
        np.linspace(-largest_px, largest_px, size[1], dtype=np.float32)[::-1] * np.linspace(0.4, 1.0, size[0], dtype=np.float32)[:, None]
    )
    place = field_positions(size).transpose(2, 0, 1)[None]
    arrays = {"rgb": rgb, "coc_px": coc_px[None, None], "place": place, "lens": np.array([[2.8, 35.0]], np.float32)}
    return {name: torch.from_numpy(np.ascontiguousarray(each)) for name, each in arrays.items()}


def session_of(model: ModelProto, profile: Path | None = None) -> onnxruntime.InferenceSession:
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = 1
    if profile is not None:
        options.enable_profiling, options.profile_file_prefix = True, str(profile)
    return onnxruntime.InferenceSession(model.SerializeToString(), options, providers=["CPUExecutionProvider"])


def blurred(session: onnxruntime.InferenceSession, inputs: dict[str, torch.Tensor]) -> np.ndarray:
    names = {each.name for each in session.get_inputs()}
    return session.run(["blurred"], {name: each.numpy() for name, each in inputs.items() if name in names})[0]


@torch.no_grad()
def twin(network: BlurNetwork, inputs: dict[str, torch.Tensor]) -> np.ndarray:
    return network(**inputs).numpy()


def coarser_model(network: BlurNetwork, factor: int = 1, spacing: float = 0.0) -> ModelProto:
    """The fast graph of a gated network, n > 2 at 1 / factor of the resolution, bins at a spacing."""
    factors = [factor if n > 2 else 1 for n in range(1, len(network.tiles.kernels) + 1)]
    return gated_model(network, thinned(weights_of(network.tiles), spacing), factors)
