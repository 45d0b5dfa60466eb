"""How long a plan will take: minutes where the budget says so, else one timed step of each run."""

import time
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import torch

from training.ablation.plan import PlannedRun
from training.ablation.results import read_result
from training.ablation.runs import device_of
from training.batches import draw_batch
from training.data_facts import DataFacts
from training.dataset import PairSet
from training.objective import loss
from training.run_folder import RunFacts, build_network
from training.weights import counting_of


def is_finished(planned: PlannedRun) -> bool:
    return read_result(planned.folder) is not None


def estimated_minutes(planned: Sequence[PlannedRun]) -> list[float]:
    """Estimate the minutes of training of each run; 0 for those that are finished. Measuring comes on top."""
    seconds_of_step: dict[tuple[str, str], float] = {}
    minutes = []
    for each in planned:
        key = (each.data_set.name, each.row.name)
        if is_finished(each) or each.settings.minutes is not None:
            minutes.append(0.0 if is_finished(each) else each.settings.minutes or 0.0)
            continue
        if key not in seconds_of_step:
            seconds_of_step[key] = step_seconds(each)
        minutes.append(seconds_of_step[key] * _steps(each) / 60.0)
    return minutes


def step_seconds(planned: PlannedRun) -> float:
    """The second of two steps, without the optimizer's part, which is small."""
    settings, pairs = planned.settings, _pairs(planned)
    facts = planned.data_set.data.facts(pairs, settings.network.lens_inputs)
    device = torch.device(device_of(settings.device))
    network = build_network(settings, _run_facts(facts)).to(device)
    rng = np.random.default_rng(0)
    seconds = 0.0
    for _ in range(2):
        started_s = time.perf_counter()
        batch = draw_batch(pairs, settings.batch, settings.crop_px, 0, rng).to(device)
        loss(network, batch, facts.radiance_scale, facts.largest_coc_px, replace(settings, depth_noise=0.0)).backward()
        seconds = time.perf_counter() - started_s
    pairs.close()
    return seconds


def _pairs(planned: PlannedRun) -> PairSet:
    train_stacks = planned.data_set.data.split(planned.data_set.held_out, 0.0, 0).train
    return PairSet(train_stacks, counting_of(planned.settings), planned.settings.cache_mib)


def _steps(planned: PlannedRun) -> float:
    return (planned.settings.epochs or 0) * len(_pairs(planned)) / planned.settings.batch


def _run_facts(facts: DataFacts) -> RunFacts:
    """What a network is built from; what a run remembers beside that is left empty."""
    return RunFacts(**vars(facts), trained_on=(), held_out=(), commit=None)
