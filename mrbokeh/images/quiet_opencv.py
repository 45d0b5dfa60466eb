"""OpenCV without its own lines on standard error, while a file is decoded that may be damaged: what is wrong, we say."""

from collections.abc import Iterator
from contextlib import contextmanager
from threading import Lock

_lock = Lock()
_state = {"inside": 0, "before": 0}


@contextmanager
def quiet_opencv() -> Iterator[None]:
    """The level of OpenCV's log is one for all threads: the first in silences it, the last out restores it."""
    from cv2.utils import logging

    with _lock:
        if not _state["inside"]:
            _state["before"] = logging.getLogLevel()
            logging.setLogLevel(logging.LOG_LEVEL_SILENT)
        _state["inside"] += 1
    try:
        yield
    finally:
        with _lock:
            _state["inside"] -= 1
            if not _state["inside"]:
                logging.setLogLevel(_state["before"])
