"""Every method on every unseen slice: scores, costs, a focus pull, tables and sheets of pictures."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np

from mrbokeh.errors import InputError
from mrbokeh.focal_stack import FocalStack
from mrbokeh.progress import track
from training.dataset import PairSet
from training.evaluation.cost import peak_memory_mib, timed
from training.evaluation.focus_pull import FRAMES, flickers, focus_pull
from training.evaluation.methods import Method
from training.evaluation.scores import Evaluation, Perceptual, Score, SliceScorer
from training.evaluation.sheets import Sheets
from training.evaluation.tables import write_numbers, write_table
from training.evaluation.unseen_slice import UnseenSlice, unseen_slice
from training.stacks import stack_name
from training.weights import WHERE_TRUTH_IS_KNOWN


@dataclass(frozen=True)
class Extras:
    """What is measured besides the scores. lpips: a distance, or None. pull_frames: of the focus pull, 0 for none."""

    lpips: Perceptual | None = None
    pull_frames: int = FRAMES
    memory: bool = True


def compare(methods: Sequence[Method], stacks: Sequence[FocalStack], out: Path, extras: Extras | None = None) -> Evaluation:
    """All slices of the stacks by all methods; writes evaluation.md, .csv and .png and evaluation_crops.png into `out`."""
    extras = extras or Extras()
    sheets = Sheets(methods, _slice_count(stacks))
    result = scored(methods, stacks, extras, sheets)
    against = ""
    if extras.pull_frames:
        pull = focus_pull(stacks[0], extras.pull_frames)
        result, against = replace(result, flicker=flickers(methods, pull)), pull.against
    write_table(out / "evaluation.md", result, against)
    write_numbers(out / "evaluation.csv", result.scores)
    sheets.write(out)
    return result


def scored(methods: Sequence[Method], stacks: Sequence[FocalStack], extras: Extras, sheets: Sheets | None = None) -> Evaluation:
    """The scores alone. Time and memory are those of methods that have run before: the first picture of each is made twice."""
    pairs = PairSet(stacks, WHERE_TRUTH_IS_KNOWN, cache_mib=0)
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


def unseen(stacks: Sequence[FocalStack], trained_on: Sequence[str]) -> list[FocalStack]:
    """The stacks that no network was trained on; raises InputError where none is left."""
    left = [stack for stack in stacks if stack_name(stack) not in trained_on]
    if not left:
        raise InputError(
            f"the networks were trained on all of these stacks ({', '.join(trained_on)}): give a scene with a stack they have not seen"
        )
    return left


def _warmed_up(method: Method, seen: UnseenSlice, memory: bool) -> float:
    """Compiles what a first picture compiles, then the memory of a second one."""
    method.blur(seen)
    return peak_memory_mib(partial(method.blur, seen)) if memory else float("nan")


def _slice_count(stacks: Sequence[FocalStack]) -> int:
    return sum(len(stack) for stack in stacks)
