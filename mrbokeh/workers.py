"""Workers for pieces of a picture: a pool of threads where that pays, the calling thread where it does not."""

from collections.abc import Callable
from concurrent.futures import Executor, Future, ThreadPoolExecutor
from os import cpu_count
from typing import Any, TypeVar

_FEW_PIXELS = 1 << 18
"""Handing pieces of smaller pictures to threads costs more than they save; slices of a small picture run side by side instead."""

_Result = TypeVar("_Result")


def workers(pixels: int, threads: int = 0) -> Executor:
    """An executor for a picture of so many pixels; threads: 0 takes all cores. What is computed must not depend on it."""
    return ThreadPoolExecutor(threads or cpu_count() or 1) if pixels > _FEW_PIXELS else CallingThread()


class CallingThread(Executor):
    """An executor without threads: work is done when it is submitted."""

    def submit(self, fn: Callable[..., _Result], /, *args: Any, **kwargs: Any) -> "Future[_Result]":
        future: Future[_Result] = Future()
        try:
            future.set_result(fn(*args, **kwargs))
        except Exception as error:  # kept for whoever asks for the result, as any executor does
            future.set_exception(error)
        return future
