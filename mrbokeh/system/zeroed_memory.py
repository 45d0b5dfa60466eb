"""Zeroed memory that goes from one use to the next: fresh zeros cost more than to make the few used ones zero again."""

from threading import Lock

import numpy as np


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
