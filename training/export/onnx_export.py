"""Export of a trained network as an ONNX file with its lens inside, written only if it computes the same as the trained network.

Beside NAME.onnx lies its card, NAME.md: what it is, learnt from which data, how good, how far, and how it was made.
"""

import json
import logging
import math
import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from mrbokeh.optics.camera import field_positions
from mrbokeh.renderers.onnx_network import METADATA_KEY, NetworkFacts, OnnxNetwork
from mrbokeh.stacks.focal_stack import FocalStack
from mrbokeh.system.atomic_files import atomic_path, write_json
from mrbokeh.system.errors import InputError
from training.data.stacks import stacks_words
from training.evaluation.methods import DISC, NO_BLUR, blur_of, disc_method, network_method, plain_methods
from training.evaluation.run_data import RunData, affordable, data_of_run, scored_on
from training.fitting.checkpoint import Progress, read_progress
from training.fitting.run_folder import RunFacts, load_run, read_facts
from training.fitting.settings import TrainSettings, read_settings, settings_words
from training.networks.network import BlurNetwork
from training.networks.network_settings import NetworkSettings

_MOST_SLICES = 12
_NAME = "this network"
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


@dataclass(frozen=True)
class Card:
    """All that a card says of a run. data: where it was found, or None."""

    settings: TrainSettings
    facts: RunFacts
    progress: Progress
    data: RunData | None


def card_path(network: Path) -> Path:
    return network.with_suffix(".md")


def write_card(run_folder: Path, network: Path, exported: NetworkFacts, form: str, given: Sequence[FocalStack] = ()) -> None:
    """Write the card of an exported run. form: of the file, in words. given: the run's stacks, if they are not where they were.

    Held-out slices are measured with the file itself, where they are found.
    """
    facts = read_facts(run_folder)
    card = Card(read_settings(run_folder), facts, read_progress(run_folder), data_of_run(facts, given))
    lines = [
        f"# {network.stem}: {_lens_words(facts, exported)}",
        "",
        "Gives a sharp picture (linear light) with diameters of blur in pixels the blur of this lens: "
        f"`mrbokeh render --rgb sharp.exr --depth sharp.exr --lens {network.name} --out blurred.exr`.",
        *_section("Data", _data(card)),
        *_section("How good", _figures(card, network)),
        *_section("Limits", _limits(card, exported)),
        *_section("Made by", {"Form": form, **_made(card)}),
    ]
    with atomic_path(card_path(network)) as temporary:
        temporary.write_text("\n".join(lines) + "\n", encoding="utf-8")


def _section(title: str, items: dict[str, str]) -> list[str]:
    return ["", f"## {title}", "", *(f"- {name}: {value}" for name, value in items.items())]


def _lens_words(facts: RunFacts, exported: NetworkFacts) -> str:
    if exported.f_numbers is not None and exported.focal_lengths_mm is not None:
        return f"the blur of a lens of {_range(exported.focal_lengths_mm)} mm at f/{_range(exported.f_numbers)}"
    return f"the blur of a lens of {facts.lens.focal_length_mm:g} mm at f/{facts.lens.f_number:.3g}"


def _data(card: Card) -> dict[str, str]:
    facts = card.facts
    slices = "" if card.data is None else f", {len(card.data.train)} slices"
    return {
        "Learnt from": f"{stacks_words(facts.trained_on)}{slices}"
        + (f", begun from the run {facts.tuned_from}" if facts.tuned_from else ""),
        "Held out": facts.held_out_words,
        "Licence of the data": " ".join(facts.licence.split()) or "unknown: ask whoever took the pictures before passing the network on",
    }


def _figures(card: Card, network: Path) -> dict[str, str]:
    held_out = () if card.data is None else card.data.held_out
    if held_out:
        blur = blur_of(network)[0]
        chosen = affordable(blur, held_out, _MOST_SLICES)
        methods = [network_method(_NAME, blur), *plain_methods()[:1], disc_method()]
        result = scored_on(methods, chosen)
        of = f"{len(chosen)} of {len(held_out)} held-out slices" + (" of a stack it learnt from" if card.facts.held_out_slices else "")
        return {
            name: f"PSNR {result.mean(name, 'psnr_db'):.2f} dB, SSIM {result.mean(name, 'ssim'):.4f}"
            + (f" ({of}, linear light up to white, measured with this file)" if name == _NAME else "")
            for name in (_NAME, NO_BLUR, DISC)
        }
    looks = [point.held_out_psnr_db for point in card.progress.curve if not math.isnan(point.held_out_psnr_db)]
    if looks:
        return {"Held-out PSNR": f"{looks[-1]:.2f} dB while training, of a few slices; the pictures are no longer where they were"}
    return {"Held-out PSNR": "unknown"}


def _limits(card: Card, exported: NetworkFacts) -> dict[str, str]:
    focus = "unknown, the pictures are no longer where they were"
    if card.data is not None:
        known = [stack.slices[index].focus_distance_m for stack, index in card.data.train]
        distances = sorted(each for each in known if each is not None)
        focus = f"{distances[0]:.3g} to {distances[-1]:.3g} m" if distances else "unknown"
        focus = "units unknown: no stack states metres" if exported.lens_guessed else focus
    size = f"{exported.width_px}x{exported.height_px} px"
    lens = _range(exported.f_numbers) if exported.f_numbers else f"{exported.lens.f_number:.3g}"
    above = "what is brighter blurs alike" if exported.linear_in_radiance else "what is brighter goes through darkened, and was not learnt"
    return {
        "Blur": f"diameters up to {exported.largest_coc_px:.1f} px" + ("" if exported.signed_coc else ", near and far alike"),
        "Focus": focus,
        "Picture": f"only {size}, which its tiles belong to" if exported.tiled else f"any size (learnt from {size})",
        "f-number": lens if exported.f_numbers else f"{lens} only",
        "Radiance": f"up to {exported.radiance_scale:.3g} (white is 1); {above}",
    }


def _made(card: Card) -> dict[str, str]:
    progress = card.progress
    stopped = f", of which those of step {progress.kept_step} are kept" if progress.kept_step != progress.step else ""
    return {
        "Settings": settings_words(card.settings),
        "Training": f"{progress.step} steps{stopped}, {progress.pictures} {'crops' if card.settings.crop_px else 'pictures'}, "
        f"{progress.elapsed_s:.0f} s",
        "Machine": card.facts.machine or "unknown",
        "Source": f"commit {card.facts.commit}" if card.facts.commit else "unknown",
    }


def _range(ends: tuple[float, float]) -> str:
    return f"{ends[0]:.3g} to {ends[1]:.3g}" if ends[1] - ends[0] > 1e-3 * ends[1] else f"{ends[0]:.3g}"
