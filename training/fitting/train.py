"""Fitting a network to focal stacks: settings and data are fixed here, then `Run` steps. All settings are in settings.py.

A run is continued only with the settings and data it was begun with.
"""

import shutil
from collections.abc import Sequence
from contextlib import closing
from dataclasses import replace
from pathlib import Path

from mrbokeh.stacks.focal_stack import FocalStack
from mrbokeh.stacks.guessed_metres import is_lens_guessed
from mrbokeh.system.errors import InputError
from training.data.dataset import PairSet
from training.data.pairs import counting_of
from training.data.stacks import Source, Split, stack_name
from training.data.training_data import TrainingData
from training.fitting.checkpoint import FILE_NAME as CHECKPOINT_NAME
from training.fitting.checkpoint import Progress
from training.fitting.distributed import Ranks, joined
from training.fitting.record import HeldOutSlices, Task
from training.fitting.run import LEAST_STEPS, Run
from training.fitting.run_folder import FILE_NAME as FACTS_NAME
from training.fitting.run_folder import RunFacts, load_run, machine_line, read_facts, source_commit, write_facts
from training.fitting.settings import FILE_NAME as SETTINGS_NAME
from training.fitting.settings import PLACE, TrainSettings, read_settings, write_settings

_SAME = 0.01
TUNING_STEPS = 20
"""The least of a run that starts from another: it has a lens already."""


def fit(
    data: TrainingData,
    run_folder: Path,
    settings: TrainSettings,
    held_out: Sequence[str] = (),
    overwrite: bool = False,
    least_steps: int = LEAST_STEPS,
    start_from: Path | None = None,
) -> Progress:
    """Train, or continue training, into run_folder; a finished run is left as it is. held_out: see `TrainingData.split`.

    overwrite: restart an existing run. least_steps: raises InputError, and writes or removes nothing, if the first steps show that a
    budget in minutes has no time for so many. start_from: a finished run whose weights a new one begins with; it is not needed to go on.
    Ctrl-C and SIGTERM end it after the step (StoppedError, a KeyboardInterrupt) with a checkpoint, from which the same call continues;
    while the first steps are timed, with nothing changed.
    Processes that torchrun started train together; all need the data, only the first needs the folder.
    """
    with joined(settings.device) as ranks:
        return _fit(data, run_folder, settings, held_out, ranks, overwrite, least_steps, start_from)


def _fit(
    data: TrainingData,
    run_folder: Path,
    settings: TrainSettings,
    held_out: Sequence[str],
    ranks: Ranks,
    overwrite: bool,
    least_steps: int,
    start_from: Path | None,
) -> Progress:
    if start_from is not None and start_from.resolve() == run_folder.resolve():
        raise InputError(f"{run_folder} is the run to start from, and stays as it is: give another --out")
    split = data.split(held_out, settings.test_fraction, settings.seed)
    pairs = PairSet(split.train, counting_of(settings), settings.cache_mib, split.train_slices)
    validation = HeldOutSlices(split.test, split.test_slices)
    _require_looks(settings, validation)

    def checked() -> RunFacts:
        if not overwrite:
            require_same_settings(run_folder, settings)
        facts = _facts_of(data, pairs, split, settings)
        before = None if overwrite or not _begun(run_folder, FACTS_NAME) else read_facts(run_folder)
        if before is not None and before.tuned_from:
            facts = _started(facts, before, before.tuned_from, settings)
        elif start_from is not None:
            facts = _started(facts, read_facts(start_from), start_from.resolve().name, settings)
        if not overwrite:
            require_same_data(run_folder, facts)
        return facts

    def begun(facts: RunFacts) -> None:
        if overwrite and run_folder.exists():
            shutil.rmtree(run_folder)
        remove_unfinished(run_folder)
        if run.is_restored:
            return  # with the commit and the machine that it was begun on
        write_settings(run_folder, settings)
        write_facts(run_folder, facts)

    with closing(pairs):
        facts = ranks.from_first(checked)
        run = Run(Task(folder=run_folder, settings=settings, facts=facts, pairs=pairs, held_out=validation), ranks, afresh=overwrite)
        if start_from is not None and not run.is_restored:
            run.learner.begin_with(load_run(start_from)[0])
        run.require_steps(least_steps if start_from is None else min(least_steps, TUNING_STEPS))
        ranks.from_first(lambda: begun(facts))
        return run.train()


def _require_looks(settings: TrainSettings, validation: HeldOutSlices) -> None:
    if settings.patience and not (settings.validate_every_s and len(validation)):
        raise InputError(
            f"a patience of {settings.patience} looks needs looks at held-out stacks, got validate_every_s={settings.validate_every_s:g} "
            f"and {len(validation)} held-out slices: hold a stack out and set validate_every_s, or set patience to 0"
        )


def _facts_of(data: TrainingData, pairs: PairSet, split: Split, settings: TrainSettings) -> RunFacts:
    found = data.facts(pairs, several_lenses=settings.network.lens_inputs, several_sizes=not settings.network.tile_px)
    return RunFacts(
        lens=found.lens,
        width_px=found.width_px,
        height_px=found.height_px,
        largest_coc_px=found.largest_coc_px,
        radiance_scale=settings.radiance_scale or found.radiance_scale,
        trained_on=tuple(stack_name(stack) for stack in pairs.stacks),
        held_out=() if split.held_out_slices else tuple(stack_name(stack) for stack in split.test),
        held_out_slices=split.held_out_slices,
        lens_guessed=any(_is_guessed(stack) for stack in pairs.stacks),
        commit=source_commit(),
        f_numbers=found.f_numbers,
        focal_lengths_mm=found.focal_lengths_mm,
        roots=tuple(sorted({str(stack.folder.resolve().parent.parent) for stack in data.stacks})),
        licence="" if data.dataset is None else data.dataset.licence,
        machine=machine_line(),
    )


def _started(facts: RunFacts, before: RunFacts, name: str, settings: TrainSettings) -> RunFacts:
    """Return the facts of a run that starts from another: with its ranges, on which its weights depend, and with what it has seen."""
    if facts.largest_coc_px > before.largest_coc_px * (1.0 + _SAME):
        raise InputError(
            f"{name} has learned blur of up to {before.largest_coc_px:.1f} px, but these pictures have {facts.largest_coc_px:.1f} px: "
            f"give smaller pictures, or train afresh"
        )
    if seen := [each for each in facts.held_out if each in before.trained_on]:
        raise InputError(f"{name} was trained on {seen[0]}, which cannot be held out later: hold out another with --held-out")
    sizes = [(each.width_px, each.height_px) for each in (facts, before)]
    if settings.network.tile_px and sizes[0] != sizes[1]:
        raise InputError(
            f"{name} has tiles for pictures of {sizes[1][0]}x{sizes[1][1]} px, got {sizes[0][0]}x{sizes[0][1]} px: train afresh"
        )
    if settings.network.lens_inputs:
        _require_known_lens(facts, before, name)
        facts = replace(facts, f_numbers=before.f_numbers, focal_lengths_mm=before.focal_lengths_mm)
    return replace(
        facts,
        largest_coc_px=before.largest_coc_px,
        radiance_scale=before.radiance_scale,
        trained_on=tuple(dict.fromkeys((*before.trained_on, *facts.trained_on))),
        roots=tuple(dict.fromkeys((*before.roots, *facts.roots))),
        licence="; ".join(dict.fromkeys(each for each in (before.licence, facts.licence) if each)),
        tuned_from=name,
    )


def _require_known_lens(facts: RunFacts, before: RunFacts, name: str) -> None:
    for what, known, now in zip(("f-numbers", "focal lengths"), before.lens_ranges, facts.lens_ranges, strict=True):
        if now[0] < known[0] * (1.0 - _SAME) or now[1] > known[1] * (1.0 + _SAME):
            raise InputError(
                f"{name} takes {what} from {known[0]:.3g} to {known[1]:.3g}, but these pictures have {now[0]:.3g} to {now[1]:.3g}: "
                f"give pictures within, or train afresh"
            )


def _is_guessed(stack: Source) -> bool:
    return not isinstance(stack, FocalStack) or (is_lens_guessed(stack) and not stack.metres_known)


def require_same_settings(run_folder: Path, settings: TrainSettings) -> None:
    """Raise InputError for settings that differ from the run's, except where and how fast it computes and how often it writes."""
    if _begun(run_folder, SETTINGS_NAME):
        _require_same(run_folder, "settings", read_settings(run_folder), settings, PLACE)


def require_same_data(run_folder: Path, facts: RunFacts) -> None:
    """Raise InputError for data that differ from the run's: what it has seen cannot be held out later."""
    if _begun(run_folder, FACTS_NAME):
        _require_same(run_folder, "data", read_facts(run_folder), facts, ("lens", "commit", "roots", "licence", "machine"))


def _begun(run_folder: Path, name: str) -> bool:
    return (run_folder / CHECKPOINT_NAME).exists() and (run_folder / name).exists()


def _require_same(run_folder: Path, what: str, before: object, now: object, may_differ: tuple[str, ...]) -> None:
    differing = [name for name, value in vars(now).items() if vars(before)[name] != value and name not in may_differ]
    if differing:
        raise InputError(
            f"{run_folder} holds a run with other {what} ({', '.join(differing)}): give another --out, or --overwrite to start again"
        )


def remove_unfinished(run_folder: Path) -> None:
    """Remove files that a killed run was writing; finished files have their final names."""
    for path in run_folder.rglob(".*.part.*"):
        path.unlink()
