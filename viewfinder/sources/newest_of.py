"""A thread that empties a stream as fast as it comes, and hands over only the newest of it."""

from collections.abc import Callable, Iterator
from threading import Event, Thread
from typing import TypeVar

from viewfinder.flow.newest import Newest

_POLL_S = 0.05

Item = TypeVar("Item")


def newest_of(produce: Callable[[Event], Iterator[Item]], stopping: Event, *, name: str, leave_s: float = 5.0) -> Iterator[Item]:
    """The newest item each time one is asked for; what came in between is dropped, so that no queue grows anywhere.

    produce: runs in the thread until the event that it gets is set, which is when `stopping` is, or when nobody asks any more. Its
    exception is raised here. leave_s: how long the end waits for the thread.
    """
    slot: Newest[Item] = Newest()
    leaving, ended, failures = Event(), Event(), list[BaseException]()

    def drain() -> None:
        try:
            for item in produce(leaving):
                slot.put(item)
        except Exception as error:
            failures.append(error)
        finally:
            ended.set()

    thread = Thread(target=drain, name=name, daemon=True)
    thread.start()
    try:
        while not stopping.is_set():
            finished = ended.is_set()
            item = slot.take(_POLL_S)
            if item is not None:
                yield item
            elif finished:
                break
    finally:
        leaving.set()
        thread.join(leave_s)
    if failures:
        raise failures[0]
