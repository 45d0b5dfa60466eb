"""Train what a plan asks for, one run after the other, and measure each on the stacks that it has not seen."""

import torch

from training import train
from training.ablation.plan import PlannedRun
from training.ablation.results import SCORES_NAME, RunResult, read_result, write_result
from training.blur_functions import blur_of
from training.evaluation.comparison import Extras, Unseen, scored
from training.evaluation.focus_pull import focus_pull
from training.evaluation.methods import network_method
from training.evaluation.scores import MEASURES, Perceptual
from training.evaluation.tables import write_numbers
from training.machine import machine_line
from training.resuming import require_same_settings
from training.run_folder import load_run
from training.stacks import stack_name

FLICKER = "flicker"


def result_of(planned: PlannedRun, lpips: Perceptual | None = None) -> RunResult:
    """Raises InputError where the folder holds a run with other settings. Finished ones are measured again only to add LPIPS."""
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
    """(means over the held-out slices, their number); each slice is in scores.csv of the run."""
    method = network_method(planned.row.name, blur_of(planned.folder, device_of(planned.settings.device))[0])
    stacks = tuple(stack for stack in planned.data_set.data.stacks if stack_name(stack) in planned.data_set.held_out)
    result = scored([method], Unseen(stacks), Extras(lpips, memory=False))
    write_numbers(planned.folder / SCORES_NAME, result.scores)
    means = {name: result.mean(method.name, name) for name in MEASURES}
    return means | {FLICKER: focus_pull(stacks[0]).flicker_of(method)}, result.slices


def device_of(name: str) -> str:
    return ("cuda" if torch.cuda.is_available() else "cpu") if name == "auto" else name
