"""Workers for pieces of a picture: a pool of threads where that pays, the calling thread where it does not.

Settings of glibc's malloc for programs that move large pictures; nothing where the C library is another one.

Zeroed memory that goes from one use to the next: fresh zeros cost more than to make the few used ones zero again.
"""

import ctypes
import sys
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Executor, Future, ThreadPoolExecutor
from functools import cache
from os import cpu_count
from threading import Lock
from typing import Any, TypeVar

import numpy as np

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


# malloc.h
_M_TRIM_THRESHOLD, _M_MMAP_THRESHOLD, _M_ARENA_MAX = -1, -3, -8
_MOST_ARENAS = 2
_LARGEST_MMAP_THRESHOLD_BYTES = 32 << 20  # glibc takes no larger one
_KEPT_BYTES = 1 << 30


def keep_few_arenas() -> None:
    """Keep to two arenas: codecs come with threads, and glibc gives each new thread an arena, which keeps what was in it.

    Ten minutes with a recording every 15 s grew by 65 MB between the medians of their thirds (tests/live/test_viewfinder_soak.py); with two
    arenas the same memory is used again.
    """
    _set(_M_ARENA_MAX, _MOST_ARENAS)


def keep_freed_pictures() -> None:
    """Use the memory of freed pictures again instead of giving it back: a new picture of 24 MB costs 6000 page faults, twice its making."""
    _set(_M_MMAP_THRESHOLD, _LARGEST_MMAP_THRESHOLD_BYTES)
    _set(_M_TRIM_THRESHOLD, _KEPT_BYTES)


def _set(parameter: int, value: int) -> None:
    if not sys.platform.startswith("linux"):
        return
    mallopt = getattr(ctypes.CDLL(None), "mallopt", None)
    if mallopt is not None:
        mallopt(parameter, value)


class ZeroedMemory:
    """Zeroed arrays for several threads; whoever takes one gives it back as zeros.

    most_bytes: what is larger than this is let go as soon as it is given back.
    """

    def __init__(self, most_bytes: int | float = np.inf) -> None:
        self._lock, self._most_bytes = Lock(), most_bytes
        self._arrays: list[np.ndarray] = []

    def take(self, elements: int, dtype: type) -> np.ndarray:
        """At least so many zeros. Arrays too small for that are let go."""
        with self._lock:
            fitting = [i for i, array in enumerate(self._arrays) if array.dtype == dtype and array.size >= elements]
            if fitting:
                return self._arrays.pop(fitting[0])
            self._arrays[:] = [array for array in self._arrays if array.dtype != dtype]
        return np.zeros(elements, dtype)

    def give_back(self, array: np.ndarray) -> None:
        """An array that holds zeros again."""
        if array.nbytes <= self._most_bytes:
            with self._lock:
                self._arrays.append(array)
