"""Export of a trained network as an ONNX file with its lens inside, written only if it computes the same as the trained network."""

import json
import logging
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from mrbokeh.optics.camera import field_positions
from mrbokeh.renderers.onnx_network import METADATA_KEY, NetworkFacts, OnnxNetwork
from mrbokeh.system.atomic_files import atomic_path, write_json
from mrbokeh.system.errors import InputError
from training.fitting.run_folder import RunFacts, load_run
from training.networks.network import BlurNetwork
from training.networks.network_settings import NetworkSettings

LARGEST_DIFFERENCE = 1e-4
OPSET = 18


@dataclass(frozen=True)
class Exported:
    """The facts in the file, and the difference between ONNX Runtime and PyTorch (see `largest_difference`)."""

    facts: NetworkFacts
    difference: float


def export_run(run_folder: Path, path: Path) -> Exported:
    """Export the finished network of a run to `path`. Raises InputError, and leaves no file, if the two do not agree."""
    network, settings, facts = load_run(run_folder)
    return export_network(network, settings.network, facts, path)


def export_network(network: BlurNetwork, settings: NetworkSettings, facts: RunFacts, path: Path) -> Exported:
    """Export a network. Without tiles height and width of the graph are free; with tiles they are those of the training pictures."""
    network_facts = network_facts_of(network, settings, facts)
    with atomic_path(path) as temporary:
        _write(network, network_facts, temporary)
        difference = largest_difference(network, OnnxNetwork(temporary))
        if not difference < LARGEST_DIFFERENCE:
            raise InputError(
                f"the exported network differs from the trained one by {difference:.1e}, more than {LARGEST_DIFFERENCE:.0e}: "
                f"nothing was written; try another version of onnxruntime or torch"
            )
    write_json(
        record_path(path), {"parity_difference": difference, "largest_allowed": LARGEST_DIFFERENCE, **json.loads(network_facts.to_json())}
    )
    return Exported(network_facts, difference)


def record_path(path: Path) -> Path:
    """Return the path of the record beside the network, for readers that do not open ONNX: its facts and the measured parity."""
    return path.with_name(path.name + ".json")


def network_facts_of(network: BlurNetwork, settings: NetworkSettings, facts: RunFacts) -> NetworkFacts:
    return NetworkFacts(
        lens=facts.lens,
        width_px=facts.width_px,
        height_px=facts.height_px,
        largest_coc_px=facts.largest_coc_px,
        radiance_scale=facts.radiance_scale,
        signed_coc=settings.signed_coc,
        tiled=network.grid is not None,
        linear_in_radiance=network.linear_in_radiance,
        reach_px=network.reach_px,
        trained_on=facts.trained_on,
        held_out_slices=facts.held_out_slices,
        lens_guessed=facts.lens_guessed,
        commit=facts.commit,
        field_position=settings.field_position,
        f_numbers=facts.lens_ranges[0] if settings.lens_inputs else None,
        focal_lengths_mm=facts.lens_ranges[1] if settings.lens_inputs else None,
    )


def _write(network: BlurNetwork, facts: NetworkFacts, path: Path) -> None:
    inputs = inputs_for_parity(facts)
    free = {} if facts.tiled else {2: torch.export.Dim.DYNAMIC, 3: torch.export.Dim.DYNAMIC}
    with _quiet(), torch.no_grad():
        program = torch.onnx.export(
            network.eval(),
            (),
            kwargs=inputs,
            input_names=list(inputs),
            output_names=["blurred"],
            dynamic_shapes={name: {} if name == "lens" else free for name in inputs},
            opset_version=OPSET,
            dynamo=True,
            verbose=False,
        )
    assert program is not None
    program.model.metadata_props[METADATA_KEY] = facts.to_json()
    program.save(str(path))


@contextmanager
def _quiet() -> Iterator[None]:
    """Silence the exporter's messages about packages that are not installed and not needed."""
    logger = logging.getLogger("torch.onnx")
    level = logger.level
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        logger.setLevel(logging.ERROR)
        try:
            yield
        finally:
            logger.setLevel(level)


def picture_for_parity(facts: NetworkFacts, seed: int = 0) -> tuple[Tensor, Tensor]:
    """Return noise with highlights up to the radiance scale and every circle of confusion that the network was trained for."""
    rng = np.random.default_rng(seed)
    height, width = (facts.height_px, facts.width_px) if facts.tiled else (96 + 2 * seed, 128 + 4 * seed)
    rgb = rng.random((1, 3, height, width), dtype=np.float32)
    rgb[rng.random(rgb.shape) < 0.01] = facts.radiance_scale
    coc_px = np.linspace(-facts.largest_coc_px, facts.largest_coc_px, width, dtype=np.float32)
    return torch.from_numpy(rgb), torch.from_numpy(np.ascontiguousarray(np.broadcast_to(coc_px, (1, 1, height, width))))


def inputs_for_parity(facts: NetworkFacts, seed: int = 0) -> dict[str, Tensor]:
    """Return all inputs of the graph by name: that picture as a whole frame, seen by a lens drawn from those trained on."""
    rgb, coc_px = picture_for_parity(facts, seed)
    inputs = {"rgb": rgb, "coc_px": coc_px}
    if facts.field_position:
        inputs["place"] = torch.from_numpy(field_positions((rgb.shape[2], rgb.shape[3])).transpose(2, 0, 1).copy())[None]
    if facts.f_numbers is not None and facts.focal_lengths_mm is not None:
        rng = np.random.default_rng(seed)
        inputs["lens"] = torch.tensor([[rng.uniform(*facts.f_numbers), rng.uniform(*facts.focal_lengths_mm)]], dtype=torch.float32)
    return inputs


@torch.no_grad()
def largest_difference(network: BlurNetwork, exported: OnnxNetwork) -> float:
    """Return the largest difference between PyTorch and ONNX Runtime over two pictures: absolute up to white (1.0), relative above."""
    differences = []
    for seed in (0, 1):
        inputs = inputs_for_parity(exported.facts, seed)
        expected = network(**inputs)[0].permute(1, 2, 0).numpy()
        planes = {name: np.ascontiguousarray(each[0].permute(1, 2, 0).numpy()) for name, each in inputs.items() if name != "lens"}
        lens = inputs["lens"][0].numpy() if "lens" in inputs else None
        got = exported.blur(planes["rgb"], planes["coc_px"][..., 0], planes.get("place"), lens)
        differences.append(float((np.abs(got - expected) / np.maximum(1.0, np.abs(expected))).max()))
    return max(differences)
