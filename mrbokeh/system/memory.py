"""Settings of glibc's malloc for programs that move large pictures; nothing where the C library is another one.

Zeroed memory that goes from one use to the next: fresh zeros cost more than to make the few used ones zero again.
"""

import ctypes
import sys
from threading import Lock

import numpy as np

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
