"""Workers for pieces of a picture: a pool of threads where that pays, the calling thread where it does not."""

from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Executor, Future, ThreadPoolExecutor
from functools import cache
from os import cpu_count
from typing import Any, TypeVar

_FEW_PIXELS = 1 << 18
"""Handing pieces of smaller pictures to threads costs more than they save; slices of a small picture run side by side instead."""

_BANDS_PER_CORE = 2

_Result = TypeVar("_Result")


@cache
def cores() -> int:
    """How many the machine has; asking it anew takes longer than a small task."""
    return cpu_count() or 1


def workers(pixels: int, threads: int = 0) -> Executor:
    """An executor for a picture of so many pixels; threads: 0 takes all cores. What is computed must not depend on it."""
    return ThreadPoolExecutor(threads or cores()) if pixels > _FEW_PIXELS else CallingThread()


def bands(length: int, least: int) -> list[tuple[int, int]]:
    """First and end of some pieces of equal length, `least` or more, that make up the whole: a few for every core."""
    size = max(least, -(-length // (_BANDS_PER_CORE * cores())))
    return [(first, min(first + size, length)) for first in range(0, length, size)]


def in_bands(pool: Executor, length: int, least: int, work: Callable[[int, int], object]) -> None:
    """Call work(first, end) for each of the bands and wait for all. What is computed must not depend on where one ends."""
    for done in [pool.submit(work, first, end) for first, end in bands(length, least)]:
        done.result()


def ahead(pool: Executor, work: Callable[[Any], _Result], tasks: Iterable[Any], at_once: int) -> Iterator[_Result]:
    """What work makes of the tasks, in their order; so many are under way or waiting to be taken: bounded memory, busy cores."""
    under_way: deque[Future[_Result]] = deque()
    for task in tasks:
        under_way.append(pool.submit(work, task))
        if len(under_way) >= at_once:
            yield under_way.popleft().result()
    while under_way:
        yield under_way.popleft().result()


class CallingThread(Executor):
    """An executor without threads: work is done when it is submitted, and what is mapped at once."""

    def submit(self, fn: Callable[..., _Result], /, *args: Any, **kwargs: Any) -> "Future[_Result]":
        future: Future[_Result] = Future()
        try:
            future.set_result(fn(*args, **kwargs))
        except Exception as error:  # kept for whoever asks for the result, as any executor does
            future.set_exception(error)
        return future

    def map(
        self,
        fn: Callable[..., _Result],
        *iterables: Iterable[Any],
        timeout: float | None = None,  # noqa: ARG002
        chunksize: int = 1,  # noqa: ARG002
    ) -> Iterator[_Result]:
        return iter([fn(*each) for each in zip(*iterables, strict=False)])
