"""Sources of training data, scene folders or a data set with a manifest, and the facts that a network needs before it is built.

A manifest knows the split, the radiance scale and the largest blur; for scene folders the pictures are read.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from mrbokeh.lens_measuring.fitting.blur_pairs import BlurPair, find_blur_pairs
from mrbokeh.optics.lens import Lens
from mrbokeh.stacks.focal_stack import FILE_NAME as STACK_NAME
from mrbokeh.stacks.focal_stack import FocalStack, find_focal_stacks, read_focal_stack
from mrbokeh.stacks.focal_stack_dataset import FILE_NAME, FocalStackDataset, file_troubles, read_focal_stack_dataset, slices_to_hold_out
from mrbokeh.system.console import track
from mrbokeh.system.errors import InputError
from training.data.dataset import PairSet
from training.data.stacks import UNSTATED_LENS, Source, Split, drawn, lens_of_slice, named, require_usable, split_stacks, stack_name

_SAME = 1e-3


@dataclass(frozen=True)
class DataFacts:
    """Facts of the data.

    lens: focused as for the first slice; only its focus may change later; among several lenses the middle one of all slices.
    largest_coc_px: the largest diameter among pixels that count. radiance_scale: the radiance at the top of the network's range.
    f_numbers, focal_lengths_mm: (lowest, highest) over all slices.
    """

    lens: Lens
    width_px: int
    height_px: int
    largest_coc_px: float
    radiance_scale: float
    f_numbers: tuple[float, float]
    focal_lengths_mm: tuple[float, float]


@dataclass(frozen=True)
class TrainingData:
    """All stacks or blur pairs, training and test; dataset: the manifest that they came with, in its order, or None."""

    stacks: tuple[Source, ...]
    dataset: FocalStackDataset | None = None

    def split(self, held_out: Sequence[str], test_fraction: float, seed: int) -> Split:
        """Split whole stacks: hold out those named; without names those of the manifest; without one a fraction.

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
        only = self.stacks[0]
        return slices_to_hold_out(only) if test_fraction > 0.0 and isinstance(only, FocalStack) else ()

    def facts(self, pairs: PairSet, several_lenses: bool = False, several_sizes: bool = False) -> DataFacts:
        """Read facts from the manifest, or from every pair to train on. several_lenses, several_sizes: see `gather_facts`."""
        if self.dataset is None:
            return gather_facts(pairs, several_lenses, several_sizes)
        return manifest_facts(self.dataset, pairs.stacks, several_lenses)


def training_data(folders: Sequence[Path]) -> TrainingData:
    """Return the stacks of a data set or of scene folders, or blur pairs. Raises InputError for what cannot be used, or a mixture."""
    datasets = [folder for folder in folders if (folder / FILE_NAME).is_file()]
    if datasets and len(folders) > 1:
        raise InputError(
            f"expected one data set or any number of scene folders, got {datasets[0]} and {len(folders) - 1} more: one network has one "
            f"split and one radiance scale, so write all scenes into one data set with `mrbokeh capture dataset`"
        )
    if datasets:
        return _of_dataset(read_focal_stack_dataset(datasets[0]))
    pairs = [pair for folder in folders for pair in find_blur_pairs(folder)]
    if pairs:
        return TrainingData(_pairs_alone(pairs, folders))
    stacks = [stack for folder in folders for stack in find_focal_stacks(folder)]
    for stack in stacks:
        _require_no_manifest(stack)
        require_usable(stack)
    return TrainingData(tuple(stacks))


def focal_stacks(stacks: Sequence[Source]) -> tuple[FocalStack, ...]:
    """Return the stacks. Raises InputError if there are blur pairs among them, which have no metres to move the focus by."""
    for stack in stacks:
        if isinstance(stack, BlurPair):
            raise InputError(f"expected focal stacks, got the blur pair {stack.folder}: of these `mrbokeh train fit` alone makes use")
    return tuple(stack for stack in stacks if isinstance(stack, FocalStack))


def _pairs_alone(pairs: Sequence[BlurPair], folders: Sequence[Path]) -> tuple[BlurPair, ...]:
    """Return the pairs. Raises InputError if there are stacks beside them, whose lens is stated while theirs is not."""
    if any(True for folder in folders for _ in folder.rglob(STACK_NAME)):
        raise InputError(f"expected blur pairs or focal stacks, got both, {pairs[0].folder} and stacks beside it: train on one kind")
    return tuple(pairs)


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
    """Refuse a part of a data set given as a scene: it would be split anew, and held-out stacks trained on."""
    dataset = stack.folder.resolve().parent.parent
    if (dataset / FILE_NAME).is_file():
        raise InputError(f"{stack.folder} belongs to the data set {dataset}: give {dataset} itself, so that its split holds")


def gather_facts(pairs: PairSet, several_lenses: bool = False, several_sizes: bool = False) -> DataFacts:
    """Gather the facts in one pass over all pairs, whose largest radiance is the scale. Raises InputError for several lenses or sizes.

    several_lenses: f-number and focal length may differ, for a network that takes them as inputs. several_sizes: blur pairs may be of
    different size, for a network without tiles: a lens is the same at every scale, so that shrunken pairs show further diameters.
    """
    lens, size = lens_of_stacks(pairs.stacks, several_lenses), pairs.size_px(0)
    for index, (stack, _) in enumerate(pairs.keys):
        if several_sizes and isinstance(stack, BlurPair):
            continue
        _require_same_size(stack_name(stack), size, pairs.size_px(index))
    largest_coc_px, largest_radiance = 0.0, 0.0
    for piece in (piece for index in track(range(len(pairs)), "look at the pictures") for piece in pairs.pieces(index)):
        counted = np.abs(piece.coc_px)[piece.weight > 0]
        largest_coc_px = max(largest_coc_px, float(counted.max(initial=0.0)))
        largest_radiance = max(largest_radiance, float(piece.all_in_focus.max()), float(piece.target.max()))
    return _facts(lens, size, (largest_coc_px, largest_radiance), pairs.stacks)


def manifest_facts(dataset: FocalStackDataset, stacks: Sequence[Source], several_lenses: bool = False) -> DataFacts:
    """Return the facts without opening a picture; raises as `gather_facts` does. stacks: those to train on."""
    size = (dataset.stacks[0].height_px, dataset.stacks[0].width_px)
    for record in dataset.stacks:
        _require_same_size(record.name, size, (record.height_px, record.width_px))
    lens = lens_of_stacks(stacks, several_lenses)
    return _facts(lens, size, (dataset.largest_coc_px, dataset.radiance_scale), stacks)


def _facts(lens: Lens, size: tuple[int, int], largest: tuple[float, float], stacks: Sequence[Source]) -> DataFacts:
    """Return the facts. size: (rows, columns). largest: circle of confusion in pixels, radiance."""
    f_numbers, focal_lengths_mm = lens_ranges(stacks)
    return DataFacts(
        lens=lens,
        width_px=size[1],
        height_px=size[0],
        largest_coc_px=largest[0],
        radiance_scale=largest[1],
        f_numbers=f_numbers,
        focal_lengths_mm=focal_lengths_mm,
    )


def lens_ranges(stacks: Sequence[Source]) -> tuple[tuple[float, float], tuple[float, float]]:
    """Return (lowest, highest) f-number and focal length in mm of all slices; f-numbers as measured if blur was calibrated."""
    lenses = [lens_of_slice(stack, index) for stack in stacks for index in range(len(stack))]
    f_numbers, focal_lengths_mm = [each.f_number for each in lenses], [each.focal_length_mm for each in lenses]
    return (min(f_numbers), max(f_numbers)), (min(focal_lengths_mm), max(focal_lengths_mm))


def lens_of_stacks(stacks: Sequence[Source], several_lenses: bool = False) -> Lens:
    """Return `common_lens`, or for several lenses the middle one of all slices, ordered by focal length and f-number.

    Raises InputError if sensors differ, since f-number and focal length do not tell how many pixels a millimetre has.
    """
    if not several_lenses:
        return common_lens(stacks)
    width_mm = _stated(stacks[0])[2]
    for stack in stacks:
        if not np.isclose(_stated(stack)[2], width_mm, rtol=_SAME):
            raise InputError(
                f"one network learns lenses on one sensor: expected a sensor {width_mm} mm wide as in the first stack, "
                f"but {stack.folder} has {_stated(stack)[2]} mm; train on it apart"
            )
    lenses = [lens_of_slice(stack, index) for stack in stacks for index in range(len(stack))]
    return sorted(lenses, key=lambda lens: (lens.focal_length_mm, lens.f_number))[len(lenses) // 2]


def common_lens(stacks: Sequence[Source]) -> Lens:
    """Return the lens of all slices, with the median f-number, since calibrated slices each have a measured one.

    Raises InputError if stacks state different lenses.
    """
    expected = _stated(stacks[0])
    for stack in stacks:
        if not np.allclose(_stated(stack), expected, rtol=_SAME):
            raise InputError(
                f"one network learns one lens: expected (focal length, f-number, sensor width) {expected} as in the first stack, "
                f"but {stack.folder} has {_stated(stack)}; train on it apart"
            )
    f_numbers = [lens_of_slice(stack, index).f_number for stack in stacks for index in range(len(stack))]
    return replace(lens_of_slice(stacks[0], 0), f_number=float(np.median(f_numbers)))


def _stated(stack: Source) -> tuple[float, float, float]:
    lens_of_slice(stack, 0)  # says what to do where nobody knows the lens
    lens = stack.lens or UNSTATED_LENS
    return lens.focal_length_mm, lens.f_number, lens.sensor_width_mm


def _require_same_size(name: str, size: tuple[int, ...], other_size: tuple[int, ...]) -> None:
    if size != other_size:
        raise InputError(
            f"one network learns one size of picture: expected {size[1]}x{size[0]} px as in the first stack, but {name} has "
            f"{other_size[1]}x{other_size[0]} px; train on it apart"
        )
