"""Fit a network to focal stacks: what is learnt from what is settled here, then `Run` steps. Every choice is in settings.py."""

from collections.abc import Sequence
from contextlib import closing
from pathlib import Path

from mrbokeh.errors import InputError
from mrbokeh.focal_stack import FocalStack
from training.checkpoint import Progress
from training.dataset import PairSet
from training.distributed import Ranks, joined
from training.held_out import HeldOutSlices
from training.record import Task
from training.resuming import remove_unfinished, require_same_data, require_same_settings
from training.run import Run
from training.run_folder import RunFacts, source_commit, write_facts
from training.settings import TrainSettings, write_settings
from training.stacks import stack_name
from training.training_data import TrainingData
from training.weights import counting_of


def fit(data: TrainingData, run_folder: Path, settings: TrainSettings, held_out: Sequence[str] = ()) -> Progress:
    """Train, or go on training, into run_folder; a finished run is left as it is. held_out: see `TrainingData.split`.

    Ctrl-C and SIGTERM end it after the step (StoppedError, a KeyboardInterrupt) with a checkpoint, from which the same call goes on.
    Processes that torchrun started train together; all need the data, only the first needs the folder.
    """
    with joined(settings.device) as ranks:
        return _fit(data, run_folder, settings, held_out, ranks)


def _fit(data: TrainingData, run_folder: Path, settings: TrainSettings, held_out: Sequence[str], ranks: Ranks) -> Progress:
    train_stacks, test_stacks = data.split(held_out, settings.test_fraction, settings.seed)
    pairs, validation = PairSet(train_stacks, counting_of(settings), settings.cache_mib), HeldOutSlices(test_stacks)
    _require_looks(settings, validation)

    def begun() -> RunFacts:
        require_same_settings(run_folder, settings)
        facts = _facts_of(data, pairs, test_stacks, settings)
        require_same_data(run_folder, facts)
        remove_unfinished(run_folder)
        write_settings(run_folder, settings)
        write_facts(run_folder, facts)
        return facts

    with closing(pairs):
        return Run(Task(run_folder, settings, ranks.from_first(begun), pairs, validation), ranks).train()


def _require_looks(settings: TrainSettings, validation: HeldOutSlices) -> None:
    if settings.patience and not (settings.validate_every_s and len(validation)):
        raise InputError(
            f"a patience of {settings.patience} looks needs looks at held-out stacks, got validate_every_s={settings.validate_every_s:g} "
            f"and {len(validation)} held-out slices: hold a stack out and set validate_every_s, or set patience to 0"
        )


def _facts_of(data: TrainingData, pairs: PairSet, test_stacks: Sequence[FocalStack], settings: TrainSettings) -> RunFacts:
    found = data.facts(pairs, several_lenses=settings.network.lens_inputs)
    return RunFacts(
        lens=found.lens,
        width_px=found.width_px,
        height_px=found.height_px,
        largest_coc_px=found.largest_coc_px,
        radiance_scale=settings.radiance_scale or found.radiance_scale,
        trained_on=tuple(stack_name(stack) for stack in pairs.stacks),
        held_out=tuple(stack_name(stack) for stack in test_stacks),
        commit=source_commit(),
        f_numbers=found.f_numbers,
        focal_lengths_mm=found.focal_lengths_mm,
    )
