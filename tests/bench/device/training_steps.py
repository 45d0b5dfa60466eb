"""Training steps of the published network on a device: precisions and torch.compile, against two cores; and checkpoints that move."""

from collections.abc import Callable, Iterator
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import torch

from mrbokeh.optics.lens import Lens
from tests.bench.device.rows import Row, Run, in_short, processor_ms, threads_of_torch
from training.data.batches import Batch
from training.fitting.checkpoint import Learner, Progress, read_checkpoint, restore_checkpoint, save_checkpoint
from training.fitting.objective import loss
from training.fitting.run_folder import RunFacts, build_network
from training.fitting.settings import TrainSettings

BAR_RATIO, CORES = 20.0, 2
SIZE_PX, SMALL_SIZE_PX, LARGEST_PX, SMALL_LARGEST_PX = (576, 384), (72, 48), 25.0, 5.0
CPU = torch.device("cpu")
PRECISIONS = ("float32", "bfloat16", "float16")


def facts_of(run: Run) -> RunFacts:
    size_px, largest_px = (SMALL_SIZE_PX, SMALL_LARGEST_PX) if run.small else (SIZE_PX, LARGEST_PX)
    return RunFacts(Lens(35.0, 2.8, 1.0, 23.5), *size_px, largest_px, 1.0, (), (), None)


def batch_of(facts: RunFacts, device: torch.device) -> Batch:
    """Return a picture of noise with circles that rise from left to right, and another picture as its target."""
    chance = torch.Generator().manual_seed(0)
    rgb, target = (torch.rand(1, 3, facts.height_px, facts.width_px, generator=chance) for _ in range(2))
    coc_px = torch.linspace(-facts.largest_coc_px, facts.largest_coc_px, facts.width_px).expand_as(rgb[:, :1]).contiguous()
    place, lens = torch.zeros_like(rgb[:, :2]), torch.tensor([[2.8, 35.0]])
    return Batch(rgb, coc_px, target, torch.ones_like(coc_px), place, lens).to(device)


class Steps:
    """A learner and its one picture; a call is a step, whose loss it returns."""

    def __init__(self, facts: RunFacts, settings: TrainSettings, device: torch.device, compiled: bool = False) -> None:
        self.facts, self.settings = facts, settings
        self.learner = Learner(build_network(settings, facts), settings, device)
        self.batch = batch_of(facts, device)
        self._network: Any = torch.compile(self.learner.network) if compiled else self.learner.network
        self._step = 0

    def __call__(self) -> float:
        self.learner.begin(1.0)
        with self.learner.autocast():
            error = loss(self._network, self.batch, self.facts.radiance_scale, self.facts.largest_coc_px, self.settings)
        self.learner.backward(error)
        self.learner.apply(self._step)
        self._step += 1
        return error.item()


def rows(run: Run) -> Iterator[Row]:
    facts = facts_of(run)
    run.tell(f"  the same step by {CORES} cores")
    with threads_of_torch(CORES):
        cpu_ms = processor_ms(Steps(facts, TrainSettings(), CPU), min(8.0, run.left_s / 4), repeats=3)
    for precision in PRECISIONS:
        yield step_row(run, facts, cpu_ms, precision, compiled=False)
    yield checkpoint_row(run)
    if not run.small:
        for precision in PRECISIONS[:2]:
            yield step_row(run, facts, cpu_ms, precision, compiled=True)


def step_row(run: Run, facts: RunFacts, cpu_ms: float, precision: Any, compiled: bool) -> Row:
    """Measure a step, with whatever waits for the device in it; or say what went wrong."""
    name = f"one training step, tiles of 200 px, circles up to {facts.largest_coc_px:g} px, {precision}"
    row = Row(f"{name}{', torch.compile' if compiled else ''}", f"{facts.width_px} x {facts.height_px}", cpu_ms=cpu_ms, cpu_cores=CORES)
    run.tell(f"  {row.name}")
    try:
        steps = Steps(facts, TrainSettings(precision=precision), run.device, compiled)
        first = steps()
        row = run.measured(replace(row, bar_ratio=BAR_RATIO), steps)
    except Exception as error:
        return replace(row, note=in_short(error))
    assert row.device_ms is not None
    return replace(row, note=f"{1e3 / row.device_ms:.1f} steps a second, CPU {1e3 / cpu_ms:.2f}; loss {first:.4f} -> {steps():.4f}")


def checkpoint_row(run: Run) -> Row:
    """Resume on the device what the processor began, and on the processor what the device went on with; the next steps are compared."""
    run.tell("  checkpoints from the processor to the device and back")
    facts = replace(facts_of(run), width_px=72, height_px=48, largest_coc_px=5.0)
    settings = TrainSettings()
    begun = [Steps(facts, settings, device) for device in (CPU, run.device, CPU)]
    _repeat(begun[0], 3)
    with TemporaryDirectory() as folder:
        losses = [moved(before, after, Path(folder) / f"{number}.pt") for number, (before, after) in enumerate(pairwise(begun))]
    row = Row("checkpoints there and back: weights after a step on either", f"{facts.width_px} x {facts.height_px}")
    row = row.compared(weights_of(begun[2]), weights_of(begun[1]))
    return replace(row, note=", ".join(f"loss {here:.6f} and {there:.6f}" for here, there in losses))


def moved(before: Steps, after: Steps, path: Path) -> tuple[float, float]:
    """Carry the state of one learner to another by a file, then let both make a step; return both losses."""
    save_checkpoint(path, Progress(), before.learner, np.random.default_rng(0))
    state = read_checkpoint(path)
    assert state is not None
    restore_checkpoint(path, state, after.learner, np.random.default_rng(0))
    return before(), after()


def weights_of(steps: Steps) -> torch.Tensor:
    return torch.cat([each.detach().float().cpu().reshape(-1) for each in steps.learner.network.parameters()])


def _repeat(work: Callable[[], object], times: int) -> None:
    for _ in range(times):
        work()
