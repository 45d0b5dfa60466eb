"""A trained network, as a run or as ONNX, as a plain function of a pair."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float32

from mrbokeh.renderers.network.onnx_network import OnnxNetwork
from training.batches import network_inputs
from training.dataset import Pair
from training.run_folder import load_run
from training.stacks import Seen

Image = Float32[np.ndarray, "height width 3"]
Blur = Callable[[Pair], Image]


def blur_of(network: Path, device: str = "cpu") -> tuple[Blur, Seen]:
    """(the function, what it was trained on) of a run folder or an .onnx file. device: of a run, cpu or cuda."""
    if network.suffix.lower() == ".onnx":
        exported = OnnxNetwork(network)

        def exported_blur(pair: Pair) -> Image:
            return exported.blur(pair.all_in_focus, pair.coc_px, pair.place, (pair.f_number, pair.focal_length_mm))

        return exported_blur, Seen(exported.facts.trained_on, exported.facts.held_out_slices)
    model, _, facts = load_run(network)
    model.to(device)

    @torch.no_grad()
    def blur(pair: Pair) -> Image:
        result = model(*(each.to(device) for each in network_inputs(pair)))
        return result[0].permute(1, 2, 0).contiguous().cpu().numpy()

    return blur, Seen(facts.trained_on, facts.held_out_slices)
