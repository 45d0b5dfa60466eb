"""What a network must know of its data before it is built: from the pictures of scenes, or from the manifest of a data set."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from mrbokeh.errors import InputError
from mrbokeh.focal_stack import FocalStack
from mrbokeh.focal_stack_dataset import FocalStackDataset
from mrbokeh.lens import Lens
from training.dataset import PairSet
from training.stacks import stack_name

_SAME = 1e-3


@dataclass(frozen=True)
class DataFacts:
    """lens: focused where the first slice was; only its focus may change later.
    largest_coc_px: the largest diameter among pixels that count. radiance_scale: the radiance at the top of the network's range.
    """

    lens: Lens
    width_px: int
    height_px: int
    largest_coc_px: float
    radiance_scale: float


def gather_facts(pairs: PairSet) -> DataFacts:
    """One pass over all pairs, whose largest radiance is the scale; raises InputError where they are not of one lens and one size."""
    lens, size = common_lens(pairs.stacks), pairs[0].coc_px.shape
    largest_coc_px, largest_radiance = 0.0, 0.0
    for index, (stack, _) in enumerate(pairs.keys):
        pair = pairs[index]
        _require_same_size(stack_name(stack), size, pair.coc_px.shape)
        counted = np.abs(pair.coc_px)[pair.weight > 0]
        largest_coc_px = max(largest_coc_px, float(counted.max(initial=0.0)))
        largest_radiance = max(largest_radiance, float(pair.all_in_focus.max()), float(pair.target.max()))
    return DataFacts(lens, size[1], size[0], largest_coc_px, largest_radiance)


def manifest_facts(dataset: FocalStackDataset, stacks: Sequence[FocalStack]) -> DataFacts:
    """No picture is opened; raises as `gather_facts` does. stacks: those to train on."""
    size = (dataset.stacks[0].height_px, dataset.stacks[0].width_px)
    for record in dataset.stacks:
        _require_same_size(record.name, size, (record.height_px, record.width_px))
    return DataFacts(common_lens(stacks), size[1], size[0], dataset.largest_coc_px, dataset.radiance_scale)


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
