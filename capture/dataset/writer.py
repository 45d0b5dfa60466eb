"""`mrbokeh capture dataset`: the stacks of some scenes as one data set. Stacks are written one by one, pictures read one by one."""

import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime
from pathlib import Path

from capture.dataset.stack_writer import StackWriting, record_of, require_usable, write_stack
from mrbokeh import __version__
from mrbokeh.stacks.focal_stack import FocalStack, find_focal_stacks
from mrbokeh.stacks.focal_stack_dataset import (
    FILE_NAME,
    FocalStackDataset,
    Part,
    StackRecord,
    file_troubles,
    slices_to_hold_out,
    write_focal_stack_dataset,
)
from mrbokeh.system.atomic_files import write_json
from mrbokeh.system.console import track
from mrbokeh.system.errors import InputError

UNFINISHED_NAME = "unfinished.json"
MAXIMUM = "maximum"
METRES_GUESSED = "metres_guessed"
"""Key in the data set's metadata: names of stacks whose circles of confusion are measured in pixels, and whose distances are guessed."""


@dataclass(frozen=True)
class DatasetPlan:
    """Plan of a data set. licence: the text. test, test_share, seed: see `split_by_viewpoint`.

    radiance_scale: "maximum", a share of the pixels such as "0.9999" (what is brighter lies beyond 1 in the network's range), or a
    radiance such as "radiance 12.5".
    """

    licence: str
    test: tuple[str, ...] = ()
    test_share: float = 0.2
    seed: int = 0
    radiance_scale: str = MAXIMUM
    writing: StackWriting = field(default_factory=StackWriting)


def write_dataset(scenes: Sequence[Path], out: Path, plan: DatasetPlan, overwrite: bool = False) -> FocalStackDataset:
    """Write the stacks of all scenes and, last, dataset.json. An interrupted run goes on where it stopped.

    Raises InputError where a stack cannot be learned from, and where `out` holds something else or is finished (unless to overwrite).
    """
    if not plan.licence.strip():
        raise InputError("a data set needs a licence note: give --licence with a text such as 'CC BY 4.0, Jane Doe' or a file")
    stacks = named_stacks(scenes)
    parts = split_by_viewpoint(list(stacks), plan.test, plan.test_share, plan.seed)
    apart = slices_of_a_single_stack(stacks, plan.test_share)
    for stack in stacks.values():
        require_usable(stack)
    _claim(out, overwrite)
    records = tuple(
        replace(write_stack(stack, out, name, parts[name], plan.writing), held_out_slices=apart.get(name, ()))
        for name, stack in track(stacks.items(), "data set", len(stacks))
    )
    scale = radiance_scale(records, plan.radiance_scale)
    metadata = {
        "made_by": f"mrbokeh {__version__}",
        "made_at": datetime.now(UTC).isoformat(timespec="seconds"),
        "radiance_scale_is": plan.radiance_scale,
        "split_seed": plan.seed,
        "split_by": "slices of one stack" if apart else "names" if plan.test else "hash of seed and name",
        METRES_GUESSED: [name for name, stack in stacks.items() if not stack.metres_known],
    }
    dataset = FocalStackDataset(folder=out, licence=plan.licence, radiance_scale=scale, stacks=records, metadata=metadata)
    (out / "LICENCE.txt").write_text(plan.licence.rstrip() + "\n", encoding="utf-8")
    write_focal_stack_dataset(dataset)
    (out / UNFINISHED_NAME).unlink()
    return dataset


def named_stacks(scenes: Sequence[Path]) -> dict[str, FocalStack]:
    """Return stacks by SCENE/VIEW. Raises InputError if two would have one name."""
    named: dict[str, FocalStack] = {}
    for scene in scenes:
        for stack in find_focal_stacks(scene):
            folder = stack.folder.resolve()
            name = f"{folder.parent.name}/{folder.name}"
            if name in named:
                raise InputError(f"two stacks are called {name}: {named[name].folder} and {stack.folder}; rename one of their scenes")
            named[name] = stack
    return named


def radiance_scale(records: Sequence[StackRecord], choice: str) -> float:
    """Return one number for the whole data set; a share is answered by the stack in which it is brightest."""
    try:
        if choice == MAXIMUM:
            scale = max(each.radiance.largest for each in records)
        elif choice.startswith("radiance "):
            scale = float(choice.removeprefix("radiance "))
        else:
            scale = max(each.radiance.quantiles[choice] for each in records)
    except (KeyError, ValueError):
        shares = ", ".join(records[0].radiance.quantiles)
        message = f"--radiance-scale must be {MAXIMUM}, one of the shares {shares}, or 'radiance X', got {choice!r}"
        raise InputError(message) from None
    if not 0.0 < scale < float("inf"):
        raise InputError(f"the radiance scale must be a positive number, but came out as {scale}: are all pictures black?")
    return scale


def _claim(out: Path, overwrite: bool) -> None:
    """Go on only in a folder that is new, ours and unfinished, or to be overwritten."""
    if (out / FILE_NAME).exists():
        if not overwrite:
            raise InputError(f"{out / FILE_NAME} exists already: give another name, or --overwrite to bring it up to date")
    elif out.exists() and any(out.iterdir()) and not (out / UNFINISHED_NAME).exists():
        raise InputError(f"{out} holds something else than a data set: give the name of a new folder")
    write_json(out / UNFINISHED_NAME, {"what": f"a data set being written; {FILE_NAME} comes last"})


def split_by_viewpoint(names: Sequence[str], test: Sequence[str] = (), test_share: float = 0.2, seed: int = 0) -> dict[str, Part]:
    """Return the part (training or test) of each stack: whole viewpoints, the same ones on every machine. names: SCENE/VIEW.

    test: names (or VIEW alone) to test on; without any, those whose hash with the seed is smallest, test_share of all and at least one
    where there are two. Raises InputError if a name is unknown or nothing is left to train on.
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
    """Return slices held out inside the stack where it is the only one and something is to be tested on; {} where viewpoints are split."""
    if len(stacks) > 1 or test_share == 0.0:
        return {}
    return {name: slices_to_hold_out(stack) for name, stack in stacks.items()}


def _is_called(full: str, name: str) -> bool:
    return name in (full, full.rsplit("/", 1)[-1])


def verify(dataset: FocalStackDataset) -> list[str]:
    """Return what is wrong, one sentence each; [] where every file is there with its size and hash."""
    return [trouble for record in track(dataset.stacks, "verify") for trouble in file_troubles(dataset, record, _sha256)]


def _sha256(path: Path) -> str:
    return record_of(path).sha256
