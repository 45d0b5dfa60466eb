"""Training pairs from FocalStack folders: (all-in-focus picture, circles of confusion) -> photographed slice."""

from collections import OrderedDict
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float32

from mrbokeh.errors import InputError
from mrbokeh.focal_stack import FocalStack, find_focal_stacks
from mrbokeh.lens import Lens

_SAME = 1e-3
# Low confidence and saturation have thresholds of their own.
_LEFT_OUT = ("moving", "border", "board")


@dataclass(frozen=True)
class Pair:
    """One slice and what it was made of.

    all_in_focus, target: (H, W, 3) linear radiance. coc_px: (H, W) signed diameters.
    weight: (H, W), 1 where the pixel counts, 0 where its depth or its radiance is not known or something moved.
    """

    all_in_focus: Float32[np.ndarray, "height width 3"]
    coc_px: Float32[np.ndarray, "height width"]
    target: Float32[np.ndarray, "height width 3"]
    weight: Float32[np.ndarray, "height width"]

    @property
    def bytes(self) -> int:
        return sum(each.nbytes for each in (self.all_in_focus, self.coc_px, self.target, self.weight))


class PairSet:
    """The pairs of some stacks, read when asked for; the last ones used are kept, up to a limit of memory."""

    def __init__(
        self, stacks: Sequence[FocalStack], least_confidence: float = 0.1, saturation: float | None = None, cache_mib: int = 2048
    ) -> None:
        self.stacks = tuple(stacks)
        self.keys = [(stack, index) for stack in self.stacks for index in range(len(stack))]
        self._least_confidence, self._saturation = least_confidence, saturation
        self._cache: OrderedDict[int, Pair] = OrderedDict()
        self._free_bytes = cache_mib * 2**20

    def __len__(self) -> int:
        return len(self.keys)

    def __getitem__(self, index: int) -> Pair:
        if index in self._cache:
            self._cache.move_to_end(index)
            return self._cache[index]
        pair = read_pair(*self.keys[index], self._least_confidence, self._saturation)
        self._cache[index] = pair
        self._free_bytes -= pair.bytes
        while self._free_bytes < 0 and len(self._cache) > 1:
            self._free_bytes += self._cache.popitem(last=False)[1].bytes
        return pair

    def label(self, index: int) -> str:
        stack, slice_index = self.keys[index]
        return f"{stack_name(stack)} slice {slice_index}"


def read_pair(stack: FocalStack, index: int, least_confidence: float = 0.1, saturation: float | None = None) -> Pair:
    target, depth_m = stack.slice_rgb(index), stack.depth_m()
    weight = (stack.depth_confidence() >= least_confidence).astype(np.float32)
    weight[~stack.slice_masks(index).valid] = 0.0
    for reason, excluded in stack.exclusions().items():
        if reason in _LEFT_OUT:
            weight[excluded] = 0.0
    if saturation is not None:
        weight[target.max(axis=2) >= saturation] = 0.0
    return Pair(stack.all_in_focus(), stack.coc_px(index, depth_m), target, weight)


@dataclass(frozen=True)
class DataFacts:
    """What a network must know of its data before it is built.

    lens: focused where the first slice was; only its focus may change later.
    largest_coc_px: the largest diameter among pixels that count. radiance_scale: the largest radiance.
    """

    lens: Lens
    width_px: int
    height_px: int
    largest_coc_px: float
    radiance_scale: float


def gather_facts(pairs: PairSet) -> DataFacts:
    """One pass over all pairs; raises InputError where they are not of one lens and one size."""
    first_stack = pairs.keys[0][0]
    lens, size = first_stack.lens_of(0), pairs[0].coc_px.shape
    largest_coc_px, largest_radiance = 0.0, 0.0
    for index, (stack, slice_index) in enumerate(pairs.keys):
        pair = pairs[index]
        _require_same(stack, lens, stack.lens_of(slice_index), size, pair.coc_px.shape)
        counted = np.abs(pair.coc_px)[pair.weight > 0]
        largest_coc_px = max(largest_coc_px, float(counted.max(initial=0.0)))
        largest_radiance = max(largest_radiance, float(pair.all_in_focus.max()), float(pair.target.max()))
    return DataFacts(lens, size[1], size[0], largest_coc_px, largest_radiance)


def _require_same(stack: FocalStack, lens: Lens, other: Lens, size: tuple[int, ...], other_size: tuple[int, ...]) -> None:
    numbers = [(each.focal_length_mm, each.f_number, each.sensor_width_mm) for each in (lens, other)]
    if not np.allclose(numbers[0], numbers[1], rtol=_SAME) or size != other_size:
        raise InputError(
            f"one network learns one lens at one size: expected (focal length, f-number, sensor width) {numbers[0]} and pictures of "
            f"{size[1]}x{size[0]} px as in the first stack, but {stack.folder} has {numbers[1]} and {other_size[1]}x{other_size[0]} px; "
            f"train on it apart"
        )


def stack_name(stack: FocalStack) -> str:
    """scene/stack: how a run remembers what it was trained on."""
    folder = stack.folder.resolve()
    return f"{folder.parent.name}/{folder.name}"


def stacks_of(scenes: Sequence[Path]) -> list[FocalStack]:
    """The stacks of the scenes that can be used: registered, merged, metric. Raises InputError naming the first that is not."""
    stacks = [stack for scene in scenes for stack in find_focal_stacks(scene)]
    for stack in stacks:
        if not (stack.merged and stack.registered):
            raise InputError(f"{stack.folder} is not registered and merged yet: run `mrbokeh capture merge` on it")
        stack.lens_of(0)
        if not stack.is_metric:
            raise InputError(f"{stack.folder} has slices without a focus distance: add them to lens.toml and ingest again")
    return stacks


def split_stacks(
    stacks: Sequence[FocalStack], held_out: Sequence[str], test_fraction: float, seed: int
) -> tuple[list[FocalStack], list[FocalStack]]:
    """(to train on, held out), whole stacks. held_out: names of stacks (their folder, or scene/folder); none draws a fraction."""
    by_name = {stack_name(stack): stack for stack in stacks}
    unknown = [name for name in held_out if not any(_is_called(known, name) for known in by_name)]
    if unknown:
        raise InputError(f"cannot hold out {unknown}: expected names of stacks among {sorted(by_name)}")
    if held_out:
        apart = [name for name in by_name if any(_is_called(name, each) for each in held_out)]
    else:
        count = max(1, round(test_fraction * len(stacks))) if test_fraction > 0 and len(stacks) > 1 else 0
        apart = list(np.random.default_rng(seed).permutation(sorted(by_name))[:count])
    train = [stack for name, stack in by_name.items() if name not in apart]
    if not train:
        raise InputError(f"all {len(by_name)} stacks are held out, none is left to train on: hold out fewer or give more scenes")
    return train, [by_name[name] for name in sorted(apart)]


def _is_called(full_name: str, name: str) -> bool:
    return full_name == name or full_name.rsplit("/", 1)[-1] == name
