"""Focal stacks to train or test on: their names, whether they are usable, and which of them, or of their slices, are held out."""

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from mrbokeh.lens_measuring.fitting.blur_pairs import BlurPair
from mrbokeh.optics.lens import Lens
from mrbokeh.stacks.focal_stack import FocalStack
from mrbokeh.system.errors import InputError

Source = FocalStack | BlurPair
"""A sharp picture and photographs of it: a stack's slices, or the one of a blur pair."""
UNSTATED_LENS = Lens(focal_length_mm=50.0, f_number=1.8, focus_distance_m=0.5)
"""The lens of blur pairs, of which nothing is stated: any will do, since diameters are given in pixels."""
ChosenSlices = Mapping[str, Sequence[int]]
"""Indices of slices by the name of their stack; of stacks that are not named, all slices are meant."""


_MOST_NAMED = 8


@dataclass(frozen=True)
class Split:
    """A split into training and test. train, test: whole stacks. held_out_slices: of the only stack, which then is in both."""

    train: tuple[Source, ...]
    test: tuple[Source, ...]
    held_out_slices: tuple[int, ...] = ()

    @property
    def train_slices(self) -> ChosenSlices:
        return self._of_only_stack([index for index in range(len(self.train[0])) if index not in self.held_out_slices])

    @property
    def test_slices(self) -> ChosenSlices:
        return self._of_only_stack(self.held_out_slices)

    def _of_only_stack(self, chosen: Sequence[int]) -> ChosenSlices:
        return {stack_name(self.train[0]): chosen} if self.held_out_slices else {}

    def words(self) -> str:
        """Describe for people what is trained on and what is held out."""
        kept = ", ".join(str(index) for index in self.held_out_slices)
        if kept:
            trained = len(self.train[0]) - len(self.held_out_slices)
            return (
                f"{trained} slices of {stack_name(self.train[0])} to train on; slices {kept} are held out of one stack, not an unseen view"
            )
        apart = ", ".join(stack_name(stack) for stack in self.test)
        if apart:
            return f"{len(self.train)} stacks to train on; held out: {apart}"
        slices = sum(len(stack) for stack in self.train)
        return f"{len(self.train)} stacks, {slices} slices to train on; nothing is held out, so nothing can tell how good the network is"


@dataclass(frozen=True)
class Seen:
    """The training data of a network: names of stacks, all slices of them but held_out_slices if there is only one."""

    stacks: tuple[str, ...]
    held_out_slices: tuple[int, ...] = ()

    def unseen_slices(self, stack: Source) -> set[int]:
        if stack_name(stack) not in self.stacks:
            return set(range(len(stack)))
        return {index for index in self.held_out_slices if index < len(stack)}


def stack_name(stack: Source) -> str:
    """Return scene/stack, the name under which a run remembers its training data."""
    folder = stack.folder.resolve()
    return f"{folder.parent.name}/{folder.name}"


def stacks_words(names: Sequence[str]) -> str:
    """Return the names of some stacks, or of many their scenes with the number of viewpoints."""
    if len(names) <= _MOST_NAMED:
        return ", ".join(names)
    scenes = Counter(name.rpartition("/")[0] for name in names)
    return ", ".join(f"{scene} ({views} views)" if views > 1 else scene for scene, views in scenes.items())


def lens_of_slice(stack: Source, index: int) -> Lens:
    """Return the lens of a slice. Raises InputError for a stack whose lens nobody knows."""
    return UNSTATED_LENS if isinstance(stack, BlurPair) else stack.lens_of(index)


def require_usable(stack: FocalStack) -> None:
    """Raise InputError unless the stack is registered, merged and metric."""
    if not (stack.merged and stack.registered):
        raise InputError(f"{stack.folder} is not registered and merged yet: run `mrbokeh capture merge` on it")
    if not stack.is_metric:
        raise InputError(
            f"{stack.folder} has slices without a focus distance: merge it again (`mrbokeh capture merge --overwrite`), which solves their "
            f"blur from the pictures, or add the distances to lens.toml and ingest"
        )
    stack.lens_of(0)


def named(stacks: Sequence[Source], held_out: Sequence[str]) -> list[str]:
    """Return the full names of stacks held out by name (their folder, or scene/folder). Raises InputError for an unknown name."""
    known = [stack_name(stack) for stack in stacks]
    unknown = [name for name in held_out if not any(_is_called(each, name) for each in known)]
    if unknown:
        raise InputError(f"cannot hold out {unknown}: expected names of stacks among {sorted(known)}")
    return [each for each in known if any(_is_called(each, name) for name in held_out)]


def drawn(stacks: Sequence[Source], test_fraction: float, seed: int) -> list[str]:
    """Draw the full names of the stacks to hold out: at least one of two or more, unless the fraction is 0."""
    count = max(1, round(test_fraction * len(stacks))) if test_fraction > 0 and len(stacks) > 1 else 0
    return list(np.random.default_rng(seed).permutation(sorted(stack_name(stack) for stack in stacks))[:count])


def split_stacks(stacks: Sequence[Source], apart: Sequence[str]) -> tuple[list[Source], list[Source]]:
    """Return (to train on, held out), whole stacks. apart: full names. Raises InputError if none is left to train on."""
    by_name = {stack_name(stack): stack for stack in stacks}
    train = [stack for name, stack in by_name.items() if name not in apart]
    if not train:
        raise InputError(f"all {len(by_name)} stacks are held out, none is left to train on: hold out fewer or give more scenes")
    return train, [by_name[name] for name in sorted(apart)]


def _is_called(full_name: str, name: str) -> bool:
    return full_name == name or full_name.rsplit("/", 1)[-1] == name
