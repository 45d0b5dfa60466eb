"""Training pairs from FocalStack folders: (all-in-focus picture, circles of confusion) -> photographed slice."""

from collections import OrderedDict
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float32

from mrbokeh.focal_stack import FocalStack
from training.stacks import stack_name
from training.weights import Counting, pixel_weight


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

    def __init__(self, stacks: Sequence[FocalStack], counting: Counting | None = None, cache_mib: int = 2048) -> None:
        self.stacks = tuple(stacks)
        self.keys = [(stack, index) for stack in self.stacks for index in range(len(stack))]
        self._counting = counting or Counting()
        self._cache: OrderedDict[int, Pair] = OrderedDict()
        self._free_bytes = cache_mib * 2**20

    def __len__(self) -> int:
        return len(self.keys)

    def __getitem__(self, index: int) -> Pair:
        if index in self._cache:
            self._cache.move_to_end(index)
            return self._cache[index]
        pair = read_pair(*self.keys[index], self._counting)
        self._cache[index] = pair
        self._free_bytes -= pair.bytes
        while self._free_bytes < 0 and len(self._cache) > 1:
            self._free_bytes += self._cache.popitem(last=False)[1].bytes
        return pair

    def label(self, index: int) -> str:
        stack, slice_index = self.keys[index]
        return f"{stack_name(stack)} slice {slice_index}"


def read_pair(stack: FocalStack, index: int, counting: Counting | None = None) -> Pair:
    target = stack.slice_rgb(index)
    weight = pixel_weight(stack, index, target, counting or Counting())
    return Pair(stack.all_in_focus(), stack.coc_px(index, stack.depth_m()), target, weight)
