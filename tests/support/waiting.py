"""Waiting in tests for what another thread or task does."""

import asyncio
import time
from collections.abc import Callable
from typing import Any


async def comes_true(true: Callable[[], Any], limit_s: float = 20.0) -> None:
    """Wait in an event loop until something holds."""
    async with asyncio.timeout(limit_s):
        while not true():
            await asyncio.sleep(0.01)


def wait_until(true: Callable[[], Any], limit_s: float = 25.0) -> None:
    """Wait for another thread until something holds."""
    end_s = time.monotonic() + limit_s
    while not true():
        assert time.monotonic() < end_s, "it never came true"
        time.sleep(0.002)
