"""Settings of glibc's malloc for programs that move large pictures; nothing where the C library is another one."""

import ctypes
import sys

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
