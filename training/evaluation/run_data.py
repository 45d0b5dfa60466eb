"""Data of a run that is over, where they still lie where it found them: its held-out slices, and some that it learnt from."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np

from mrbokeh.stacks.focal_stack import FILE_NAME, FocalStack, read_focal_stack
from training.data.pairs import read_pair
from training.data.stacks import stack_name
from training.evaluation.comparison import Extras, Unseen, scored, timed
from training.evaluation.methods import Blur, Method
from training.evaluation.scores import Evaluation
from training.fitting.run_folder import RunFacts

LONGEST_S = 60.0
"""Of a network over slices that nobody asked it to be measured on."""


@dataclass(frozen=True)
class RunData:
    """The stacks of a run that were found. train, held_out: (stack, index of a slice), all of them."""

    train: tuple[tuple[FocalStack, int], ...]
    held_out: tuple[tuple[FocalStack, int], ...]


def data_of_run(facts: RunFacts, given: Sequence[FocalStack] = ()) -> RunData | None:
    """Return the data of a run, or None if a stack or a file of one is missing. given: stacks to take before those where the run knew."""
    stacks = {stack_name(stack): stack for stack in given}
    for name in (*facts.trained_on, *facts.held_out):
        folders = [Path(root) / name for root in facts.roots if (Path(root) / name / FILE_NAME).is_file()]
        if name not in stacks and not folders:
            return None
        stacks[name] = stack = stacks[name] if name in stacks else read_focal_stack(folders[0])
        files = [stack.all_in_focus_path, stack.depth_path, *(stack.folder / each.path for each in stack.slices)]
        if not all(path.is_file() for path in files):
            return None
    apart = facts.held_out_slices
    whole = [(stacks[name], index) for name in facts.trained_on for index in range(len(stacks[name]))]
    test = [(stacks[name], index) for name in facts.held_out for index in range(len(stacks[name]))]
    train = tuple(each for each in whole if each[1] not in apart)
    return RunData(train, tuple(each for each in whole if each[1] in apart) if apart else tuple(test))


def some(slices: Sequence[tuple[FocalStack, int]], most: int) -> list[tuple[FocalStack, int]]:
    """Return at most so many slices, spread over all."""
    return [slices[index] for index in np.unique(np.linspace(0, len(slices) - 1, min(most, len(slices))).round().astype(int))]


def affordable(blur: Blur, slices: Sequence[tuple[FocalStack, int]], most: int) -> list[tuple[FocalStack, int]]:
    """Return at most so many slices, spread over all, and no more than the network is done with in LONGEST_S."""
    _, seconds = timed(partial(blur, read_pair(*slices[0])))
    return some(slices, max(1, min(most, int(LONGEST_S / seconds))))


def scored_on(methods: Sequence[Method], slices: Sequence[tuple[FocalStack, int]]) -> Evaluation:
    """Score methods on these slices alone."""
    chosen: dict[str, list[int]] = {}
    for stack, index in slices:
        chosen.setdefault(stack_name(stack), []).append(index)
    stacks = {stack_name(stack): stack for stack, _ in slices}
    return scored(methods, Unseen(tuple(stacks.values()), chosen), Extras(memory=False, pull_frames=0))
