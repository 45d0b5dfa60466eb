"""Training of the planned runs, one after the other, their evaluation on held-out stacks, and an estimate of the time it takes.

The estimate is the budget in minutes, or else from one timed step of each run.
"""

import time
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import torch

from training.ablation.plan import PlannedRun
from training.ablation.tables import SCORES_NAME, RunResult, read_result, write_result
from training.data.batches import draw_batch
from training.data.dataset import PairSet
from training.data.pairs import counting_of
from training.data.stacks import stack_name
from training.data.training_data import focal_stacks
from training.evaluation.comparison import Extras, Unseen, focus_pull, scored
from training.evaluation.methods import blur_of, network_method
from training.evaluation.report import write_numbers
from training.evaluation.scores import MEASURES, Perceptual
from training.fitting import train
from training.fitting.objective import loss
from training.fitting.run_folder import RunFacts, build_network, load_run, machine_line
from training.fitting.train import require_same_settings

FLICKER = "flicker"


def result_of(planned: PlannedRun, lpips: Perceptual | None = None) -> RunResult:
    """Train and evaluate a run; a finished one is evaluated again only to add LPIPS.

    Raises InputError if its folder holds other settings.
    """
    require_same_settings(planned.folder, planned.settings)
    before = read_result(planned.folder)
    if before is not None and (lpips is None or before.measures["lpips"] == before.measures["lpips"]):
        return before
    progress = train.fit(planned.data_set.data, planned.folder, planned.settings, planned.data_set.held_out, least_steps=0)
    network, _, facts = load_run(planned.folder)
    measures, slices = _measured(planned, lpips)
    result = RunResult(
        data_set=planned.data_set.name,
        row=planned.row.name,
        seed=planned.seed,
        slices=slices,
        measures=measures,
        parameters=sum(each.numel() for each in network.parameters()),
        seconds=round(progress.elapsed_s, 2),
        steps=progress.step,
        commit=facts.commit,
        machine=machine_line() if before is None else before.machine,
    )
    write_result(planned.folder, result)
    return result


def _measured(planned: PlannedRun, lpips: Perceptual | None) -> tuple[dict[str, float], int]:
    """Return (means over the held-out slices, their number); each slice is in scores.csv of the run."""
    method = network_method(planned.row.name, blur_of(planned.folder, device_of(planned.settings.device))[0])
    stacks = focal_stacks([stack for stack in planned.data_set.data.stacks if stack_name(stack) in planned.data_set.held_out])
    result = scored([method], Unseen(stacks), Extras(lpips, memory=False))
    write_numbers(planned.folder / SCORES_NAME, result.scores)
    means = {name: result.mean(method.name, name) for name in MEASURES}
    return means | {FLICKER: focus_pull(stacks[0]).flicker_of(method)}, result.slices


def device_of(name: str) -> str:
    return ("cuda" if torch.cuda.is_available() else "cpu") if name == "auto" else name


def is_finished(planned: PlannedRun) -> bool:
    return read_result(planned.folder) is not None


def estimated_minutes(planned: Sequence[PlannedRun]) -> list[float]:
    """Estimate the minutes of training of each run; 0 for those that are finished. Evaluation comes on top."""
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
    """Time the second of two steps, without the optimizer's part, which is small."""
    settings, pairs = planned.settings, _pairs(planned)
    facts = planned.data_set.data.facts(pairs, settings.network.lens_inputs)
    device = torch.device(device_of(settings.device))
    network = build_network(settings, RunFacts(**vars(facts), trained_on=(), held_out=(), commit=None)).to(device)
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
