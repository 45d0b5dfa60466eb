"""Where the stacks come from: scene folders, or a data set whose manifest knows its split, its radiance scale and its largest blur."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from mrbokeh.stacks.focal_stack import FocalStack, find_focal_stacks, read_focal_stack
from mrbokeh.stacks.focal_stack_dataset import FILE_NAME, FocalStackDataset, file_troubles, read_focal_stack_dataset, slices_to_hold_out
from mrbokeh.system.errors import InputError
from training.data_facts import DataFacts, gather_facts, manifest_facts
from training.dataset import PairSet
from training.stacks import Split, drawn, named, require_usable, split_stacks, stack_name


@dataclass(frozen=True)
class TrainingData:
    """All stacks, whichever part they belong to; dataset: the manifest that they came with, in its order, or None."""

    stacks: tuple[FocalStack, ...]
    dataset: FocalStackDataset | None = None

    def split(self, held_out: Sequence[str], test_fraction: float, seed: int) -> Split:
        """Whole stacks: held out are those named; without names those of the manifest; without one a fraction.

        Of a single stack slices are held out, those of the manifest or `slices_to_hold_out`, unless the fraction is 0.
        """
        if held_out:
            apart = named(self.stacks, held_out)
        elif self.dataset is not None:
            apart = [stack_name(stack) for stack, record in zip(self.stacks, self.dataset.stacks, strict=True) if record.part == "test"]
        else:
            apart = drawn(self.stacks, test_fraction, seed)
        train, test = split_stacks(self.stacks, apart)
        slices = self._slices_apart(test_fraction) if len(self.stacks) == 1 else ()
        return Split(tuple(train), tuple(train if slices else test), slices)

    def _slices_apart(self, test_fraction: float) -> tuple[int, ...]:
        if self.dataset is not None:
            return self.dataset.stacks[0].held_out_slices
        return slices_to_hold_out(self.stacks[0]) if test_fraction > 0.0 else ()

    def facts(self, pairs: PairSet, several_lenses: bool = False) -> DataFacts:
        """Read facts from the manifest, or by a look at every pair to train on. several_lenses: f-number and focal length may differ."""
        if self.dataset is None:
            return gather_facts(pairs, several_lenses)
        return manifest_facts(self.dataset, pairs.stacks, several_lenses)


def training_data(folders: Sequence[Path]) -> TrainingData:
    """The stacks of a data set, or of scene folders. Raises InputError where they cannot be used or are a mixture of both."""
    datasets = [folder for folder in folders if (folder / FILE_NAME).is_file()]
    if datasets and len(folders) > 1:
        raise InputError(
            f"expected one data set or any number of scene folders, got {datasets[0]} and {len(folders) - 1} more: one network has one "
            f"split and one radiance scale, so write all scenes into one data set with `mrbokeh capture dataset`"
        )
    if datasets:
        return _of_dataset(read_focal_stack_dataset(datasets[0]))
    stacks = [stack for folder in folders for stack in find_focal_stacks(folder)]
    for stack in stacks:
        _require_no_manifest(stack)
        require_usable(stack)
    return TrainingData(tuple(stacks))


def _of_dataset(dataset: FocalStackDataset) -> TrainingData:
    trouble = next((each for record in dataset.stacks for each in file_troubles(dataset, record)), None)
    if trouble is not None:
        raise InputError(
            f"{dataset.folder} is not the data set that its {FILE_NAME} describes: {trouble}; "
            f"`mrbokeh capture dataset --out {dataset.folder} --verify` names everything that differs"
        )
    stacks = tuple(read_focal_stack(dataset.folder / record.name) for record in dataset.stacks)
    for stack in stacks:
        require_usable(stack)
    return TrainingData(stacks, dataset)


def _require_no_manifest(stack: FocalStack) -> None:
    """A part of a data set, given as a scene, would be split anew, and what is held out trained on."""
    dataset = stack.folder.resolve().parent.parent
    if (dataset / FILE_NAME).is_file():
        raise InputError(f"{stack.folder} belongs to the data set {dataset}: give {dataset} itself, so that its split holds")
