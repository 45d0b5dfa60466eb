"""All pairs of some stacks as one sequence, read on demand and in bounded memory, whole or a few rows at a time.

Parts of pictures are read ahead by a thread in the background.
"""

import functools
import threading
from collections import OrderedDict
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

from mrbokeh.lens_measuring.fitting.blur_pairs import BlurPair
from mrbokeh.system.resources import cores
from training.data.pairs import Counting, Pair, StackRows, read_pair, read_stack_rows, slice_size_px
from training.data.stacks import ChosenSlices, Source, stack_name

__all__ = ["Pair", "PairSet", "read_pair"]
_PLANES = 8  # of float32: two pictures, circles of confusion, weight
_PIECE_ROWS = 256  # of a picture that is looked at piece by piece
_PIECES_AHEAD = 4


@dataclass(frozen=True)
class Window:
    """Some rows of a pair, over the whole width. bytes: its size in memory, known before it is read."""

    index: int
    top: int
    bottom: int
    bytes: int


class ReadAhead:
    """A cache of windows that were used or are expected; the least recently used go first when `limit_bytes` is full.

    Expecting windows makes reading faster and never changes what is read. All calls come from one thread.
    Beyond the limit there is only what reading takes in passing (about one window more for each reader) and a single window larger
    than the limit. An error in a reader is raised where its window is requested.
    """

    def __init__(self, read: Callable[[Window], Pair], limit_bytes: int, readers: int = 1) -> None:
        self._read, self.limit_bytes, self.readers = read, limit_bytes, readers
        self._kept: OrderedDict[Window, Future[Pair]] = OrderedDict()
        self._expected: set[Window] = set()
        self._pool: ThreadPoolExecutor | None = None
        self.held_bytes = 0

    def __len__(self) -> int:
        return len(self._kept)

    def get(self, window: Window) -> Pair:
        """Take a window from memory or from the thread that is reading it, or read it here and now."""
        self._expected.discard(window)
        future = self._kept.get(window)
        if future is None:
            self._make_room(window.bytes, over=True)
            future = Future()
            future.set_result(self._read(window))
            self._keep(window, future)
        self._kept.move_to_end(window)
        try:
            return future.result()
        except Exception:
            self._forget(window)
            raise

    def expect(self, windows: Iterable[Window]) -> None:
        """Start reading the next windows in this order, as far as memory allows; earlier expectations are dropped."""
        ordered = list(dict.fromkeys(windows))
        self._expected = set(ordered)
        for window in ordered:
            if window in self._kept:
                continue
            if not self._make_room(window.bytes):
                return
            self._pool = self._pool or ThreadPoolExecutor(self.readers, thread_name_prefix="read-ahead")
            self._keep(window, self._pool.submit(self._read, window))

    def close(self) -> None:
        """Stop reading and drop everything."""
        if self._pool is not None:
            self._pool.shutdown(cancel_futures=True)
        self._pool, self.held_bytes = None, 0
        self._kept.clear()

    def _keep(self, window: Window, future: "Future[Pair]") -> None:
        self._kept[window] = future
        self.held_bytes += window.bytes

    def _forget(self, window: Window) -> None:
        del self._kept[window]
        self.held_bytes -= window.bytes

    def _make_room(self, needed_bytes: int, over: bool = False) -> bool:
        """Free memory and tell whether the bytes fit now: first unexpected windows, oldest first; with `over` also expected ones."""
        for expected_too in (False, True) if over else (False,):
            for window in list(self._kept):
                if self.held_bytes + needed_bytes <= self.limit_bytes:
                    return True
                if self._kept[window].done() and (expected_too or window not in self._expected):
                    self._forget(window)
        return self.held_bytes + needed_bytes <= self.limit_bytes


class PairSet:
    """The pairs of some stacks; recently used and expected pictures are cached, up to a limit.

    slices: which to use, by name of the stack; stacks without an entry use all.
    cache_mib: the limit. If all pairs fit they stay, and each file is read once; slices share what belongs to their stack.
    Otherwise crops are cut from windows: only the rows of a crop are read, over the whole width, as the file holds them. On slices of
    24 megapixels 256 rows take 1/16 of the time and memory of a whole one. Reading takes about one window more in passing for each reader.
    A copy for another process (pickle) starts with an empty memory.
    """

    def __init__(
        self, stacks: Sequence[Source], counting: Counting | None = None, cache_mib: int = 2048, slices: ChosenSlices | None = None
    ) -> None:
        self.stacks, self._slices = tuple(stacks), dict(slices or {})
        self.keys = [(stack, index) for stack in self.stacks for index in self._slices.get(stack_name(stack), range(len(stack)))]
        self._counting, self._cache_mib = counting or Counting(), cache_mib
        self._sizes_px: dict[int, tuple[int, int]] = {}
        self._shared: dict[Path, StackRows] = {}
        self._sharing = threading.Lock()
        self._cache = ReadAhead(self._read, cache_mib * 2**20, readers=max(1, min(4, cores() // 2)))

    def __reduce__(self) -> tuple[type["PairSet"], tuple[tuple[Source, ...], Counting, int, ChosenSlices]]:
        return PairSet, (self.stacks, self._counting, self._cache_mib, self._slices)

    def __len__(self) -> int:
        return len(self.keys)

    def __getitem__(self, index: int) -> Pair:
        """Return the whole picture."""
        return self._cache.get(self._window(index, slice(0, self.size_px(index)[0])))

    def label(self, index: int) -> str:
        stack, slice_index = self.keys[index]
        return f"{stack_name(stack)} slice {slice_index}"

    def left_out(self, stack: Source) -> list[int]:
        """Return the slices of one of its stacks that do not belong to it."""
        chosen = self._slices.get(stack_name(stack))
        return [] if chosen is None else [index for index in range(len(stack)) if index not in chosen]

    def size_px(self, index: int) -> tuple[int, int]:
        """Return (height, width) of a pair, from the header of its file."""
        if index not in self._sizes_px:
            self._sizes_px[index] = slice_size_px(*self.keys[index])
        return self._sizes_px[index]

    @functools.cached_property
    def all_fit(self) -> bool:
        """Tell whether all pairs stay in memory once they are read."""
        return sum(self._bytes(index, self.size_px(index)[0]) for index in range(len(self))) <= self._cache.limit_bytes

    @functools.cached_property
    def one_size(self) -> bool:
        return len({self.size_px(index) for index in range(len(self))}) == 1

    def window(self, index: int, rows: slice) -> Window:
        """Return what to read for some rows: just these, or the whole picture if all of them fit."""
        return self._window(index, slice(0, self.size_px(index)[0]) if self.all_fit else rows)

    def cut(self, window: Window, rows: slice, columns: slice) -> Pair:
        """Cut a part of a picture (a view) from a window with all its rows; rows, columns: in the picture."""
        return self._cache.get(window).cut(slice(rows.start - window.top, rows.stop - window.top), columns)

    def expect(self, windows: Iterable[Window]) -> None:
        """Read these in the background, the first one first."""
        if len(self._cache) < len(self) or not self.all_fit:
            self._cache.expect(windows)

    def pieces(self, index: int) -> Iterator[Pair]:
        """Yield a whole picture in one piece if all fit in memory, else a few rows after the other."""
        height = self.size_px(index)[0]
        step = height if self.all_fit else _PIECE_ROWS
        windows = [self._window(index, slice(top, min(top + step, height))) for top in range(0, height, step)]
        for number, window in enumerate(windows):
            self.expect(windows[number : number + _PIECES_AHEAD])
            yield self._cache.get(window)

    def close(self) -> None:
        """Drop all pictures and stop reading ahead."""
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

    def _stack_rows(self, stack: Source, rows: slice) -> StackRows | None:
        """Return what belongs to the whole picture, read by whoever comes first; None of a pair, which is in memory."""
        if isinstance(stack, BlurPair):
            return None
        with self._sharing:
            if stack.folder not in self._shared:
                self._shared[stack.folder] = read_stack_rows(stack, rows)
            return self._shared[stack.folder]
