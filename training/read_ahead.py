"""Parts of pictures, read by a thread in the background before they are asked for, in bounded memory."""

from collections import OrderedDict
from collections.abc import Callable, Iterable
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass

from training.pairs import Pair


@dataclass(frozen=True)
class Window:
    """Some rows of a pair, over the whole width. bytes: what it takes in memory, known before it is read."""

    index: int
    top: int
    bottom: int
    bytes: int


class ReadAhead:
    """Windows that were used or are expected; the longest unused go first when `limit_bytes` is full.

    What is read does not depend on what was expected; only when does. Used from one thread, which all windows are handed to.
    Beyond the limit there are only what reading takes in passing (about one window more for each reader) and, where a single
    window is larger than the limit, that one window. A mistake in a reader is raised where its window is asked for.
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
        """Start reading what will be asked for next, in this order, as far as memory allows; forgets what was expected before."""
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
        """Stop reading and forget everything."""
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
        """Whether it fits now. Goes first: what is read and not expected, oldest first; for `over` also what is expected."""
        for expected_too in (False, True) if over else (False,):
            for window in list(self._kept):
                if self.held_bytes + needed_bytes <= self.limit_bytes:
                    return True
                if self._kept[window].done() and (expected_too or window not in self._expected):
                    self._forget(window)
        return self.held_bytes + needed_bytes <= self.limit_bytes
