"""Focal stacks to train on or to test on: their names, whether they can be used, and which are held out."""

from collections.abc import Sequence

import numpy as np

from mrbokeh.errors import InputError
from mrbokeh.focal_stack import FocalStack


def stack_name(stack: FocalStack) -> str:
    """scene/stack: how a run remembers what it was trained on."""
    folder = stack.folder.resolve()
    return f"{folder.parent.name}/{folder.name}"


def require_usable(stack: FocalStack) -> None:
    """Registered, merged and metric, or InputError."""
    if not (stack.merged and stack.registered):
        raise InputError(f"{stack.folder} is not registered and merged yet: run `mrbokeh capture merge` on it")
    stack.lens_of(0)
    if not stack.is_metric:
        raise InputError(f"{stack.folder} has slices without a focus distance: add them to lens.toml and ingest again")


def named(stacks: Sequence[FocalStack], held_out: Sequence[str]) -> list[str]:
    """Full names of the stacks that are held out by name (their folder, or scene/folder). Raises InputError for a name nobody has."""
    known = [stack_name(stack) for stack in stacks]
    unknown = [name for name in held_out if not any(_is_called(each, name) for each in known)]
    if unknown:
        raise InputError(f"cannot hold out {unknown}: expected names of stacks among {sorted(known)}")
    return [each for each in known if any(_is_called(each, name) for name in held_out)]


def drawn(stacks: Sequence[FocalStack], test_fraction: float, seed: int) -> list[str]:
    """Full names of the stacks that are held out by lot: at least one where there are two, unless the fraction is 0."""
    count = max(1, round(test_fraction * len(stacks))) if test_fraction > 0 and len(stacks) > 1 else 0
    return list(np.random.default_rng(seed).permutation(sorted(stack_name(stack) for stack in stacks))[:count])


def split_stacks(stacks: Sequence[FocalStack], apart: Sequence[str]) -> tuple[list[FocalStack], list[FocalStack]]:
    """(to train on, held out), whole stacks. apart: full names. Raises InputError where none is left to train on."""
    by_name = {stack_name(stack): stack for stack in stacks}
    train = [stack for name, stack in by_name.items() if name not in apart]
    if not train:
        raise InputError(f"all {len(by_name)} stacks are held out, none is left to train on: hold out fewer or give more scenes")
    return train, [by_name[name] for name in sorted(apart)]


def _is_called(full_name: str, name: str) -> bool:
    return full_name == name or full_name.rsplit("/", 1)[-1] == name
