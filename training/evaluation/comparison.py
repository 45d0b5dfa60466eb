"""Every method on every unseen slice: scores, costs, a focus pull, tables and sheets of pictures."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path

import numpy as np

from mrbokeh.stacks.focal_stack import FocalStack
from mrbokeh.system.console import track
from mrbokeh.system.errors import InputError
from training.dataset import PairSet
from training.evaluation.cost import peak_memory_mib, timed
from training.evaluation.focus_pull import FRAMES, flickers, focus_pull
from training.evaluation.methods import Method
from training.evaluation.scores import Evaluation, Perceptual, Score, SliceScorer
from training.evaluation.sheets import Sheets
from training.evaluation.tables import write_numbers, write_table
from training.evaluation.unseen_slice import UnseenSlice, unseen_slice
from training.stacks import ChosenSlices, Seen, stack_name
from training.weights import WHERE_TRUTH_IS_KNOWN


@dataclass(frozen=True)
class Extras:
    """What is measured besides the scores. lpips: a distance, or None. pull_frames: of the focus pull, 0 for none."""

    lpips: Perceptual | None = None
    pull_frames: int = FRAMES
    memory: bool = True


@dataclass(frozen=True)
class Unseen:
    """What no network was trained on: whole stacks, or, with slices, some slices held out of stacks that networks were trained on."""

    stacks: tuple[FocalStack, ...]
    slices: ChosenSlices = field(default_factory=dict)

    @property
    def words(self) -> str:
        return "slices held out of one stack, not an unseen view" if self.slices else "slices of stacks not trained on"

    def pairs(self) -> PairSet:
        return PairSet(self.stacks, WHERE_TRUTH_IS_KNOWN, cache_mib=0, slices=self.slices)


def compare(methods: Sequence[Method], unseen: Unseen, out: Path, extras: Extras | None = None) -> Evaluation:
    """All unseen slices by all methods; writes evaluation.md, .csv and .png and evaluation_crops.png into `out`.

    A focus pull goes over a whole stack, so there is none where slices of it were trained on.
    """
    extras = extras or Extras()
    sheets = Sheets(methods, len(unseen.pairs()))
    result = scored(methods, unseen, extras, sheets)
    against = ""
    if extras.pull_frames and not unseen.slices:
        pull = focus_pull(unseen.stacks[0], extras.pull_frames)
        result, against = replace(result, flicker=flickers(methods, pull)), pull.against
    write_table(out / "evaluation.md", result, against, unseen.words)
    write_numbers(out / "evaluation.csv", result.scores)
    sheets.write(out)
    return result


def scored(methods: Sequence[Method], unseen: Unseen, extras: Extras, sheets: Sheets | None = None) -> Evaluation:
    """The scores alone. Time and memory are those of methods that have run before: the first picture of each is made twice."""
    pairs = unseen.pairs()
    scores: list[Score] = []
    memory = {}
    for index in track(range(len(pairs)), "evaluate"):
        seen = unseen_slice(pairs, index)
        if index == 0:
            memory = {each.name: _warmed_up(each, seen, extras.memory) for each in methods}
        results = {each.name: timed(partial(each.blur, seen)) for each in methods}
        scorer = SliceScorer(seen, extras.lpips)
        scores += [scorer.score(name, picture, seconds) for name, (picture, seconds) in results.items()]
        if sheets is not None:
            sheets.note(index, seen, {name: picture for name, (picture, _) in results.items()})
    networks, gaussians = (tuple(each.name for each in methods if each.kind == kind) for kind in ("network", "Gaussian"))
    return Evaluation(tuple(scores), networks, gaussians, {}, {name: each for name, each in memory.items() if not np.isnan(each)})


def unseen_of(stacks: Sequence[FocalStack], seen: Sequence[Seen]) -> Unseen:
    """The stacks that no network was trained on; where there are none, the slices that all of them held out.

    Raises InputError where nothing is left.
    """
    slices = {stack_name(stack): sorted(set.intersection(*(each.unseen_slices(stack) for each in seen))) for stack in stacks}
    whole = tuple(stack for stack in stacks if len(slices[stack_name(stack)]) == len(stack))
    if whole:
        return Unseen(whole)
    left = tuple(stack for stack in stacks if slices[stack_name(stack)])
    if not left:
        raise InputError(
            f"the networks were trained on every slice of these stacks ({', '.join(slices)}): give a scene with a stack they have not "
            f"seen, or train again on one stack of at least 3 slices, of which `mrbokeh train fit` holds some out"
        )
    return Unseen(left, {stack_name(stack): slices[stack_name(stack)] for stack in left})


def _warmed_up(method: Method, seen: UnseenSlice, memory: bool) -> float:
    """Compiles what a first picture compiles, then the memory of a second one."""
    method.blur(seen)
    return peak_memory_mib(partial(method.blur, seen)) if memory else float("nan")
