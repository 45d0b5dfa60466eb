"""The folder of a training run: settings, training data, checkpoint, curve and the finished network."""

import os
import platform
import subprocess
from dataclasses import dataclass
from pathlib import Path
from pickle import UnpicklingError
from typing import Any

import torch

from mrbokeh.optics.lens import Lens
from mrbokeh.optics.lens_file import lens_from_json, lens_to_json
from mrbokeh.system.atomic_files import atomic_path, read_json, write_json
from mrbokeh.system.errors import InputError
from training.data.stacks import stacks_words
from training.fitting.settings import TrainSettings, read_settings
from training.networks.network import BlurNetwork, LensRanges, TileGrid

FORMAT = "mrbokeh-training-run"
VERSION = 1
FILE_NAME = "run.json"
NETWORK_NAME = "network.pt"


@dataclass(frozen=True)
class RunFacts:
    """The range of validity and the origin of a trained network.

    largest_coc_px: diameter. radiance_scale: the radiance at the upper end of the network's range.
    trained_on, held_out: names of stacks. held_out_slices: of the only stack, if there is one.
    commit: of the source, or None without git. lens_guessed: see NetworkFacts.
    f_numbers, focal_lengths_mm: (lowest, highest) of the data; None: those of `lens` alone.
    roots: folders in which the stacks lay by their names. licence: of the data set, "" if nobody knows. machine: that it was begun on.
    tuned_from: name of the run that it started from, whose stacks are among trained_on; "" if it began afresh.
    """

    lens: Lens
    width_px: int
    height_px: int
    largest_coc_px: float
    radiance_scale: float
    trained_on: tuple[str, ...]
    held_out: tuple[str, ...]
    commit: str | None
    f_numbers: tuple[float, float] | None = None
    focal_lengths_mm: tuple[float, float] | None = None
    held_out_slices: tuple[int, ...] = ()
    lens_guessed: bool = False
    roots: tuple[str, ...] = ()
    licence: str = ""
    machine: str = ""
    tuned_from: str = ""

    @property
    def lens_ranges(self) -> LensRanges:
        one_f_number, one_focal_length_mm = (self.lens.f_number,) * 2, (self.lens.focal_length_mm,) * 2
        return self.f_numbers or one_f_number, self.focal_lengths_mm or one_focal_length_mm

    @property
    def held_out_words(self) -> str:
        if self.held_out_slices:
            return f"slices {', '.join(map(str, self.held_out_slices))} of the only stack"
        return stacks_words(self.held_out) or "nothing"

    def to_json(self) -> dict[str, Any]:
        return {"format": FORMAT, "version": VERSION, **vars(self), "lens": lens_to_json(self.lens)}


def facts_from_json(document: dict[str, Any], where: str) -> RunFacts:
    if document.get("format") != FORMAT or document.get("version") != VERSION:
        raise InputError(f"{where}: expected format {FORMAT!r} version {VERSION}, got {document.get('format')!r}: train again")
    lens = lens_from_json(document["lens"], where)
    others = {name: value for name, value in document.items() if name not in ("format", "version", "lens")}
    values: dict[str, Any] = {name: tuple(value) if isinstance(value, list) else value for name, value in others.items()}
    return RunFacts(lens=lens, **values)


def write_facts(folder: Path, facts: RunFacts) -> None:
    write_json(folder / FILE_NAME, facts.to_json())


def read_facts(folder: Path) -> RunFacts:
    return facts_from_json(read_json(folder / FILE_NAME, "a training run (RUN/run.json)"), str(folder / FILE_NAME))


def build_network(settings: TrainSettings, facts: RunFacts) -> BlurNetwork:
    """Build a fresh network for these data, with weights drawn from the seed."""
    tile = settings.network
    grid = TileGrid(facts.height_px, facts.width_px, tile.tile_px, tile.overlap_px) if tile.tile_px else None
    # Of the processor alone: on a machine with GPUs the state of every one of them would be asked for, which takes memory on each.
    with torch.random.fork_rng(devices=[]):
        torch.default_generator.manual_seed(settings.seed)
        return BlurNetwork(
            settings=tile,
            largest_coc_px=facts.largest_coc_px,
            radiance_scale=facts.radiance_scale,
            grid=grid,
            lens_ranges=facts.lens_ranges,
        )


def save_network(folder: Path, network: BlurNetwork) -> None:
    with atomic_path(folder / NETWORK_NAME) as temporary:
        torch.save(network.state_dict(), temporary)


def load_run(folder: Path) -> tuple[BlurNetwork, TrainSettings, RunFacts]:
    """Load the finished network of a run, in evaluation mode on the CPU."""
    settings, facts = read_settings(folder), read_facts(folder)
    if not (folder / NETWORK_NAME).is_file():
        raise InputError(
            f"{folder} has no finished network ({NETWORK_NAME}): run the same `mrbokeh train fit` again, it goes on where it was"
        )
    network = build_network(settings, facts)
    try:
        network.load_state_dict(torch.load(folder / NETWORK_NAME, map_location="cpu", weights_only=True))
    except (OSError, RuntimeError, ValueError, EOFError, UnpicklingError):
        raise InputError(f"{folder / NETWORK_NAME} is cut off or not of this run: copy it again, or train again") from None
    return network.eval(), settings, facts


def machine_line() -> str:
    """Describe the machine in one line: processor, cores, the GPU if torch sees one, and versions."""
    gpu = [torch.cuda.get_device_name(0)] if torch.cuda.is_available() else []
    parts = [_processor(), f"{os.cpu_count()} cores", *gpu, f"Python {platform.python_version()}", f"torch {torch.__version__}"]
    return ", ".join(parts)


def _processor() -> str:
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
    except OSError:
        return platform.processor() or platform.machine()
    return next((line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")), platform.machine())


def source_commit() -> str | None:
    """Return the git commit of the source, with "-dirty" if files differ from it; None outside a checkout."""
    folder = Path(__file__).resolve().parent
    command = ["git", "-C", str(folder), "describe", "--always", "--dirty", "--abbrev=40", "--exclude", "*"]
    try:
        return subprocess.run(command, capture_output=True, text=True, check=True, timeout=10).stdout.strip() or None
    except (OSError, subprocess.SubprocessError):
        return None
