"""How many decibel a fast graph loses against the trained network."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import onnxruntime
import torch
from torch import Tensor

from mrbokeh.optics.camera import field_positions
from mrbokeh.renderers.network.onnx_network import NetworkFacts
from training.batches import stack_pairs
from training.dataset import PairSet
from training.network import BlurNetwork
from training.training_data import training_data
from training.weights import WHERE_TRUTH_IS_KNOWN

ASSUMED_PSNR_DB = 42.0  # of a trained network against the truth, where no truth is given (Mandl et al. 2024, Table 1)
SLICES, LARGEST_SIDE_PX = 4, 448


@dataclass(frozen=True)
class Look:
    """One picture: inputs of the graph by name, what the trained network makes of it, and the truth and its weight where they are known.

    All (1, C, H, W); lens is (1, 2).
    """

    inputs: dict[str, Tensor]
    trained: Tensor
    truth: Tensor | None = None
    weight: Tensor | None = None


def loss_db(session: onnxruntime.InferenceSession, looks: Sequence[Look]) -> float:
    """Mean over pictures of the PSNR (linear radiance clipped to [0, 1]) that is lost against the truth.

    Without a truth it is what the difference to the trained network would cost one that is ASSUMED_PSNR_DB from it:
    10 lg(1 + error / error of that network).
    """
    losses = []
    for look in looks:
        names = {each.name for each in session.get_inputs()}
        feed = {name: values.numpy() for name, values in look.inputs.items() if name in names}
        fast = torch.from_numpy(session.run(["blurred"], feed)[0])
        if look.truth is None:
            losses.append(10.0 * math.log10(1.0 + _error(fast, look.trained, None) * 10.0 ** (ASSUMED_PSNR_DB / 10.0)))
        else:
            errors = [max(_error(each, look.truth, look.weight), 1e-12) for each in (fast, look.trained)]
            losses.append(10.0 * math.log10(errors[0] / errors[1]))
    return float(np.mean(losses))


def made_up_look(network: BlurNetwork, facts: NetworkFacts, size_px: tuple[int, int] = (216, 384)) -> Look:
    """A picture of everything: texture of all scales, lights, and every circle of confusion, in ramps and in steps."""
    height, width = (facts.height_px, facts.width_px) if facts.tiled else size_px
    rng = np.random.default_rng(0)
    rgb = np.zeros((3, height, width), np.float32)
    for scale_px in (1, 4, 16, 64):
        coarse = rng.random((3, -(-height // scale_px), -(-width // scale_px)), dtype=np.float32)
        rgb += 0.25 * np.kron(coarse, np.ones((1, scale_px, scale_px), np.float32))[:, :height, :width]
    lights = rng.integers(0, (height, width), size=(12, 2))
    rgb[:, lights[:, 0], lights[:, 1]] = facts.radiance_scale
    ramp = np.broadcast_to(np.linspace(-1.0, 1.0, width, dtype=np.float32), (height, width)).copy()
    ramp[height // 4 : height // 2] = np.repeat(rng.uniform(-1.0, 1.0, -(-width // 24)), 24)[:width]
    inputs = {"rgb": rgb[None], "coc_px": (facts.largest_coc_px * ramp)[None, None]}
    inputs["place"] = field_positions((height, width)).transpose(2, 0, 1)[None]
    inputs["lens"] = np.array([[facts.lens.f_number, facts.lens.focal_length_mm]], np.float32)
    return _looked({name: torch.from_numpy(np.ascontiguousarray(values, np.float32)) for name, values in inputs.items()}, network)


def looks_at(scenes: Sequence[Path], network: BlurNetwork, facts: NetworkFacts) -> list[Look]:
    """Some slices that the network was not trained on, or any where it was trained on all; no more than the middle of large pictures."""
    from training.stacks import Seen, stack_name

    stacks = training_data(scenes).stacks
    seen = Seen(facts.trained_on, facts.held_out_slices)
    slices = {stack_name(stack): sorted(seen.unseen_slices(stack)) for stack in stacks}
    pairs = PairSet(stacks, WHERE_TRUTH_IS_KNOWN, cache_mib=0, slices=slices if any(slices.values()) else None)
    looks = []
    for index in np.unique(np.linspace(0, len(pairs) - 1, SLICES).round()):
        pair = pairs[int(index)]
        if not facts.tiled:
            pair = pair.cut(*(_middle(length) for length in pair.coc_px.shape))
        batch = stack_pairs([pair])
        inputs = {"rgb": batch.rgb, "coc_px": batch.coc_px, "place": batch.place, "lens": batch.lens}
        looks.append(_looked(inputs, network, batch.target, batch.weight))
    return looks


@torch.no_grad()
def _looked(inputs: dict[str, Tensor], network: BlurNetwork, truth: Tensor | None = None, weight: Tensor | None = None) -> Look:
    return Look(inputs, network(**inputs), truth, weight)


def _error(a: Tensor, b: Tensor, weight: Tensor | None) -> float:
    squares = (a.clamp(0, 1) - b.clamp(0, 1)).square()
    return float(squares.mean()) if weight is None else float((weight * squares).sum() / (3.0 * weight.sum()).clamp(min=1e-6))


def _middle(length_px: int) -> slice:
    start = max(0, (length_px - LARGEST_SIDE_PX) // 2)
    return slice(start, min(length_px, start + LARGEST_SIDE_PX))
