"""A trained network, as a run or as ONNX, as a plain function of picture and circles of confusion."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float32

from mrbokeh.renderers.onnx_network import OnnxNetwork
from training.run_folder import load_run

Blur = Callable[[Float32[np.ndarray, "height width 3"], Float32[np.ndarray, "height width"]], Float32[np.ndarray, "height width 3"]]


def blur_of(network: Path) -> tuple[Blur, tuple[str, ...]]:
    """(the function, names of the stacks it was trained on) of a run folder or an .onnx file."""
    if network.suffix.lower() == ".onnx":
        exported = OnnxNetwork(network)
        return exported.blur, exported.facts.trained_on
    model, _, facts = load_run(network)

    @torch.no_grad()
    def blur(
        rgb: Float32[np.ndarray, "height width 3"], coc_px: Float32[np.ndarray, "height width"]
    ) -> Float32[np.ndarray, "height width 3"]:
        result = model(torch.from_numpy(np.ascontiguousarray(rgb.transpose(2, 0, 1)))[None], torch.from_numpy(coc_px)[None, None])
        return result[0].permute(1, 2, 0).contiguous().numpy()

    return blur, facts.trained_on
