"""Threads and memory: worker pools for pieces of a picture, scratch arrays that stay zeroed, and settings of glibc's malloc."""

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
    """Return the number of cores, cached because asking the system takes longer than a small task."""
    return cpu_count() or 1


def workers(pixels: int, threads: int = 0) -> Executor:
    """Return an executor for a picture of this many pixels: threads if it is large, else the calling thread.

    threads: 0 takes all cores. What is computed must not depend on it.
    """
    return ThreadPoolExecutor(threads or cores()) if pixels > _FEW_PIXELS else CallingThread()


def bands(length: int, least: int) -> list[tuple[int, int]]:
    """Return (first, end) of equal pieces, each at least `least` long, that make up the whole: a few for every core."""
    size = max(least, -(-length // (_BANDS_PER_CORE * cores())))
    return [(first, min(first + size, length)) for first in range(0, length, size)]


def in_bands(pool: Executor, length: int, least: int, work: Callable[[int, int], object]) -> None:
    """Call work(first, end) for each of the bands and wait for all. Results must not depend on where a band ends."""
    for done in [pool.submit(work, first, end) for first, end in bands(length, least)]:
        done.result()


def ahead(pool: Executor, work: Callable[[Any], _Result], tasks: Iterable[Any], at_once: int) -> Iterator[_Result]:
    """Yield the results of work on the tasks in order, with at most `at_once` tasks under way: bounded memory, busy cores."""
    under_way: deque[Future[_Result]] = deque()
    for task in tasks:
        under_way.append(pool.submit(work, task))
        if len(under_way) >= at_once:
            yield under_way.popleft().result()
    while under_way:
        yield under_way.popleft().result()


class CallingThread(Executor):
    """Executor without threads: work is done when it is submitted."""

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
    """Limit glibc to two arenas: codecs create threads, and each new thread gets an arena that keeps what was in it.

    Ten minutes with a recording every 15 s grew by 65 MB between the medians of their thirds (tests/viewfinder/test_viewfinder.py); with
    two arenas the same memory is used again.
    """
    _set(_M_ARENA_MAX, _MOST_ARENAS)


def keep_freed_pictures() -> None:
    """Reuse the memory of freed pictures instead of returning it: a new picture of 24 MB costs 6000 page faults, twice its making."""
    _set(_M_MMAP_THRESHOLD, _LARGEST_MMAP_THRESHOLD_BYTES)
    _set(_M_TRIM_THRESHOLD, _KEPT_BYTES)


def _set(parameter: int, value: int) -> None:
    if not sys.platform.startswith("linux"):
        return
    mallopt = getattr(ctypes.CDLL(None), "mallopt", None)
    if mallopt is not None:
        mallopt(parameter, value)


class ZeroedMemory:
    """Pool of zeroed scratch arrays for several threads: zeroing the few used elements again is cheaper than fresh zeros.

    Whoever takes an array returns it as zeros. most_bytes: larger arrays are freed when they are given back.
    """

    def __init__(self, most_bytes: int | float = np.inf) -> None:
        self._lock, self._most_bytes = Lock(), most_bytes
        self._arrays: list[np.ndarray] = []

    def take(self, elements: int, dtype: type) -> np.ndarray:
        """Return at least this many zeros and free arrays that are too small."""
        with self._lock:
            fitting = [i for i, array in enumerate(self._arrays) if array.dtype == dtype and array.size >= elements]
            if fitting:
                return self._arrays.pop(fitting[0])
            self._arrays[:] = [array for array in self._arrays if array.dtype != dtype]
        return np.zeros(elements, dtype)

    def give_back(self, array: np.ndarray) -> None:
        """Take back an array that holds zeros again."""
        if array.nbytes <= self._most_bytes:
            with self._lock:
                self._arrays.append(array)
