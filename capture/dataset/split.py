"""Which stacks are for training and which for testing: whole viewpoints, the same ones on every machine; of a single one some slices."""

import hashlib
from collections.abc import Mapping, Sequence

from mrbokeh.stacks.focal_stack import FocalStack
from mrbokeh.stacks.focal_stack_dataset import Part, slices_to_hold_out
from mrbokeh.system.errors import InputError


def split_by_viewpoint(names: Sequence[str], test: Sequence[str] = (), test_share: float = 0.2, seed: int = 0) -> dict[str, Part]:
    """The part of each stack. names: SCENE/VIEW.

    test: names (or VIEW alone) to test on; without any, those whose hash with the seed is smallest, test_share of all and at least one
    where there are two. Raises InputError where a name is unknown or nothing is left to train on.
    """
    unknown = [name for name in test if not any(_is_called(full, name) for full in names)]
    if unknown:
        raise InputError(f"cannot test on {', '.join(unknown)}: expected viewpoints among {', '.join(sorted(names))}")
    if test:
        apart = {full for full in names if any(_is_called(full, name) for name in test)}
    else:
        if not 0.0 <= test_share < 1.0:
            raise InputError(f"the share of test viewpoints must lie in [0, 1), got {test_share:g}")
        count = max(1, round(test_share * len(names))) if len(names) > 1 and test_share > 0 else 0
        apart = set(sorted(names, key=lambda name: hashlib.sha256(f"{seed}:{name}".encode()).hexdigest())[:count])
    if len(apart) == len(names):
        raise InputError(f"all {len(names)} viewpoints are for testing, none is left to train on: test on fewer or give more scenes")
    return {name: "test" if name in apart else "train" for name in names}


def slices_of_a_single_stack(stacks: Mapping[str, FocalStack], test_share: float = 0.2) -> dict[str, tuple[int, ...]]:
    """Slices held out inside the stack where it is the only one and something is to be tested on; {} where viewpoints are split."""
    if len(stacks) > 1 or test_share == 0.0:
        return {}
    return {name: slices_to_hold_out(stack) for name, stack in stacks.items()}


def _is_called(full: str, name: str) -> bool:
    return name in (full, full.rsplit("/", 1)[-1])
