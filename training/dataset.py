"""All pairs of some stacks as one sequence, read when asked for and in bounded memory, whole or a few rows at a time."""

import functools
import threading
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path

from mrbokeh.stacks.focal_stack import FocalStack
from mrbokeh.system.workers import cores
from training.pairs import Pair, read_pair
from training.read_ahead import ReadAhead, Window
from training.slice_rows import StackRows, read_stack_rows, slice_size_px
from training.stacks import ChosenSlices, stack_name
from training.weights import Counting

__all__ = ["Pair", "PairSet", "read_pair"]

_PLANES = 8  # of float32: two pictures, circles of confusion, weight
_PIECE_ROWS = 256  # of a picture that is looked at piece by piece
_PIECES_AHEAD = 4


class PairSet:
    """The pairs of some stacks; what was used last and what comes next is kept in memory, up to a limit.

    slices: only these of the stacks that it names.
    cache_mib: the limit. Where all pairs fit they stay, and each file is read once; slices share what belongs to their stack.
    Where they do not, crops are cut from windows: only
    the rows of a crop are read, over the whole width, as the file holds them. On slices of 24 megapixels 256 rows take 1/16 of the
    time and memory of a whole one. Reading takes about one window more in passing for each reader (`ReadAhead`).
    A copy for another process (pickle) starts with an empty memory.
    """

    def __init__(
        self, stacks: Sequence[FocalStack], counting: Counting | None = None, cache_mib: int = 2048, slices: ChosenSlices | None = None
    ) -> None:
        self.stacks, self._slices = tuple(stacks), dict(slices or {})
        self.keys = [(stack, index) for stack in self.stacks for index in self._slices.get(stack_name(stack), range(len(stack)))]
        self._counting, self._cache_mib = counting or Counting(), cache_mib
        self._sizes_px: dict[int, tuple[int, int]] = {}
        self._shared: dict[Path, StackRows] = {}
        self._sharing = threading.Lock()
        self._cache = ReadAhead(self._read, cache_mib * 2**20, readers=max(1, min(4, cores() // 2)))

    def __reduce__(self) -> tuple[type["PairSet"], tuple[tuple[FocalStack, ...], Counting, int, ChosenSlices]]:
        return PairSet, (self.stacks, self._counting, self._cache_mib, self._slices)

    def __len__(self) -> int:
        return len(self.keys)

    def __getitem__(self, index: int) -> Pair:
        """The whole picture."""
        return self._cache.get(self._window(index, slice(0, self.size_px(index)[0])))

    def label(self, index: int) -> str:
        stack, slice_index = self.keys[index]
        return f"{stack_name(stack)} slice {slice_index}"

    def left_out(self, stack: FocalStack) -> list[int]:
        """The slices of one of its stacks that do not belong to it."""
        chosen = self._slices.get(stack_name(stack))
        return [] if chosen is None else [index for index in range(len(stack)) if index not in chosen]

    def size_px(self, index: int) -> tuple[int, int]:
        """(height, width) of a pair, from the header of its file."""
        if index not in self._sizes_px:
            self._sizes_px[index] = slice_size_px(*self.keys[index])
        return self._sizes_px[index]

    @functools.cached_property
    def all_fit(self) -> bool:
        """Whether all pairs stay in memory once they are read."""
        return sum(self._bytes(index, self.size_px(index)[0]) for index in range(len(self))) <= self._cache.limit_bytes

    def window(self, index: int, rows: slice) -> Window:
        """What to read for some rows: just these, or the whole picture where all of them fit."""
        return self._window(index, slice(0, self.size_px(index)[0]) if self.all_fit else rows)

    def cut(self, window: Window, rows: slice, columns: slice) -> Pair:
        """A part of a picture (a view) from a window with all its rows; rows, columns: in the picture."""
        return self._cache.get(window).cut(slice(rows.start - window.top, rows.stop - window.top), columns)

    def expect(self, windows: Iterable[Window]) -> None:
        """Read these in the background, the first one first."""
        if len(self._cache) < len(self) or not self.all_fit:
            self._cache.expect(windows)

    def pieces(self, index: int) -> Iterator[Pair]:
        """A whole picture in one piece where all fit in memory, else a few rows after the other."""
        height = self.size_px(index)[0]
        step = height if self.all_fit else _PIECE_ROWS
        windows = [self._window(index, slice(top, min(top + step, height))) for top in range(0, height, step)]
        for number, window in enumerate(windows):
            self.expect(windows[number : number + _PIECES_AHEAD])
            yield self._cache.get(window)

    def close(self) -> None:
        """Forget all pictures and stop reading ahead."""
        self._cache.close()
        self._shared.clear()

    def _window(self, index: int, rows: slice) -> Window:
        return Window(index, rows.start, rows.stop, self._bytes(index, rows.stop - rows.start))

    def _bytes(self, index: int, rows: int) -> int:
        return rows * self.size_px(index)[1] * (4 * _PLANES + (1 if self._counting.one_sided else 0))

    def _read(self, window: Window) -> Pair:
        stack, index = self.keys[window.index]
        rows = slice(window.top, window.bottom)
        return read_pair(stack, index, self._counting, rows, self._stack_rows(stack, rows) if self.all_fit else None)

    def _stack_rows(self, stack: FocalStack, rows: slice) -> StackRows:
        """Return what belongs to the whole picture, read by whoever comes first."""
        with self._sharing:
            if stack.folder not in self._shared:
                self._shared[stack.folder] = read_stack_rows(stack, rows)
            return self._shared[stack.folder]
