"""The card of an exported network, NAME.md beside NAME.onnx: what it is, learnt from which data, how good, how far, and how it was made."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from mrbokeh.renderers.onnx_network import NetworkFacts
from mrbokeh.stacks.focal_stack import FocalStack
from mrbokeh.system.atomic_files import atomic_path
from training.data.stacks import stacks_words
from training.evaluation.methods import DISC, NO_BLUR, blur_of, disc_method, network_method, plain_methods
from training.evaluation.run_data import RunData, affordable, data_of_run, scored_on
from training.fitting.checkpoint import Progress, read_progress
from training.fitting.run_folder import RunFacts, read_facts
from training.fitting.settings import TrainSettings, read_settings, settings_words

_MOST_SLICES = 12
_NAME = "this network"


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
