"""Frames are freed and allocated all the time: their memory goes back to the system at once, or it would lie about in pieces."""

import ctypes
import sys

_MMAP_THRESHOLD = -3
_LARGE_BYTES = 4 << 20


def give_back_large_blocks() -> None:
    """For the rest of this process, where the C library is glibc; elsewhere nothing happens.

    glibc learns from freed blocks of up to 32 MB to keep such blocks in its heap, where 1080p frames of 25 MB leave holes. Measured
    on a worker of `mrbokeh video`: 200 MB less of 900, at no cost in time.
    """
    if not sys.platform.startswith("linux"):
        return
    mallopt = getattr(ctypes.CDLL(None), "mallopt", None)
    if mallopt is not None:
        mallopt(_MMAP_THRESHOLD, _LARGE_BYTES)
