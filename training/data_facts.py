"""What a network must know of its data before it is built: from the pictures of scenes, or from the manifest of a data set."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from mrbokeh.optics.lens import Lens
from mrbokeh.stacks.focal_stack import FocalStack
from mrbokeh.stacks.focal_stack_dataset import FocalStackDataset
from mrbokeh.system.console import track
from mrbokeh.system.errors import InputError
from training.dataset import PairSet
from training.stacks import stack_name

_SAME = 1e-3


@dataclass(frozen=True)
class DataFacts:
    """lens: focused where the first slice was; only its focus may change later, or of several lenses the one in the middle of all slices.
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


def gather_facts(pairs: PairSet, several_lenses: bool = False) -> DataFacts:
    """One pass over all pairs, whose largest radiance is the scale; raises InputError where they are not of one lens and one size.

    several_lenses: for a network that is told which, f-number and focal length may differ.
    """
    lens, size = lens_of_stacks(pairs.stacks, several_lenses), pairs.size_px(0)
    for index, (stack, _) in enumerate(pairs.keys):
        _require_same_size(stack_name(stack), size, pairs.size_px(index))
    largest_coc_px, largest_radiance = 0.0, 0.0
    for piece in (piece for index in track(range(len(pairs)), "look at the pictures") for piece in pairs.pieces(index)):
        counted = np.abs(piece.coc_px)[piece.weight > 0]
        largest_coc_px = max(largest_coc_px, float(counted.max(initial=0.0)))
        largest_radiance = max(largest_radiance, float(piece.all_in_focus.max()), float(piece.target.max()))
    return DataFacts(lens, size[1], size[0], largest_coc_px, largest_radiance, *lens_ranges(pairs.stacks))


def manifest_facts(dataset: FocalStackDataset, stacks: Sequence[FocalStack], several_lenses: bool = False) -> DataFacts:
    """No picture is opened; raises as `gather_facts` does. stacks: those to train on."""
    size = (dataset.stacks[0].height_px, dataset.stacks[0].width_px)
    for record in dataset.stacks:
        _require_same_size(record.name, size, (record.height_px, record.width_px))
    lens = lens_of_stacks(stacks, several_lenses)
    return DataFacts(lens, size[1], size[0], dataset.largest_coc_px, dataset.radiance_scale, *lens_ranges(stacks))


def lens_ranges(stacks: Sequence[FocalStack]) -> tuple[tuple[float, float], tuple[float, float]]:
    """(lowest, highest) f-number and focal length in mm of all slices; f-numbers as measured where blur was calibrated."""
    lenses = [stack.lens_of(index) for stack in stacks for index in range(len(stack))]
    f_numbers, focal_lengths_mm = [each.f_number for each in lenses], [each.focal_length_mm for each in lenses]
    return (min(f_numbers), max(f_numbers)), (min(focal_lengths_mm), max(focal_lengths_mm))


def lens_of_stacks(stacks: Sequence[FocalStack], several_lenses: bool = False) -> Lens:
    """`common_lens`, or for several: the one in the middle of all slices, ordered by focal length and f-number.

    Raises InputError where sensors differ, for f-number and focal length do not tell how many pixels a millimetre has.
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
    lenses = [stack.lens_of(index) for stack in stacks for index in range(len(stack))]
    return sorted(lenses, key=lambda lens: (lens.focal_length_mm, lens.f_number))[len(lenses) // 2]


def common_lens(stacks: Sequence[FocalStack]) -> Lens:
    """The lens of all slices; its f-number is the median, since where blur was calibrated each slice has a measured one of its own.

    Raises InputError where stacks state different lenses.
    """
    expected = _stated(stacks[0])
    for stack in stacks:
        if not np.allclose(_stated(stack), expected, rtol=_SAME):
            raise InputError(
                f"one network learns one lens: expected (focal length, f-number, sensor width) {expected} as in the first stack, "
                f"but {stack.folder} has {_stated(stack)}; train on it apart"
            )
    f_numbers = [stack.lens_of(index).f_number for stack in stacks for index in range(len(stack))]
    return replace(stacks[0].lens_of(0), f_number=float(np.median(f_numbers)))


def _stated(stack: FocalStack) -> tuple[float, float, float]:
    stack.lens_of(0)  # says what to do where nobody knows the lens
    assert stack.lens is not None
    return stack.lens.focal_length_mm, stack.lens.f_number, stack.lens.sensor_width_mm


def _require_same_size(name: str, size: tuple[int, ...], other_size: tuple[int, ...]) -> None:
    if size != other_size:
        raise InputError(
            f"one network learns one size of picture: expected {size[1]}x{size[0]} px as in the first stack, but {name} has "
            f"{other_size[1]}x{other_size[0]} px; train on it apart"
        )
