"""Memory that is given back as zeros is handed out again, one array to one taker."""

import numpy as np

from mrbokeh.system.resources import ZeroedMemory


def test_what_was_given_back_is_taken_again_if_it_is_large_enough() -> None:
    memory = ZeroedMemory()
    first = memory.take(100, np.float32)
    assert first.size == 100 and first.dtype == np.float32 and not first.any()
    memory.give_back(first)
    assert memory.take(80, np.float32) is first
    assert memory.take(80, np.float32) is not first
    memory.give_back(first)
    assert memory.take(101, np.float32).size == 101
    assert memory.take(80, np.float64).dtype == np.float64


def test_what_is_too_large_is_not_kept() -> None:
    memory = ZeroedMemory(most_bytes=400)
    small, large = memory.take(100, np.float32), memory.take(101, np.float32)
    memory.give_back(large)
    memory.give_back(small)
    assert memory.take(1, np.float32) is small
    assert memory.take(1, np.float32) is not large
