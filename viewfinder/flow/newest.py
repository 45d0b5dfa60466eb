"""Newest: the hand-over between two threads that keeps one thing, the newest; never a queue."""

from threading import Condition
from typing import Generic, TypeVar

Item = TypeVar("Item")


class Newest(Generic[Item]):
    """One slot: `put` replaces what was not taken in time, `take` waits for something new."""

    def __init__(self) -> None:
        self._changed = Condition()
        self._item: Item | None = None

    def put(self, item: Item) -> None:
        with self._changed:
            self._item = item
            self._changed.notify()

    def take(self, timeout_s: float) -> Item | None:
        """The newest item, which leaves the slot; None if nothing came in time."""
        with self._changed:
            self._changed.wait_for(lambda: self._item is not None, timeout_s)
            item, self._item = self._item, None
            return item

    @property
    def waiting(self) -> bool:
        """Whether something lies in the slot."""
        with self._changed:
            return self._item is not None
