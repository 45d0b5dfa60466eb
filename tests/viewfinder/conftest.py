"""Tests that are coroutines, and clips that several tests of the viewfinder take."""

import asyncio
import inspect
from pathlib import Path

import numpy as np
import pytest


@pytest.hookimpl(tryfirst=True)
def pytest_pyfunc_call(pyfuncitem: pytest.Function) -> bool | None:
    """Run a coroutine in an event loop of its own; it fails if that takes longer than 90 s."""
    if not inspect.iscoroutinefunction(pyfuncitem.obj):
        return None
    arguments = {name: pyfuncitem.funcargs[name] for name in pyfuncitem._fixtureinfo.argnames}
    asyncio.run(asyncio.wait_for(pyfuncitem.obj(**arguments), 90.0))
    return True


@pytest.fixture
def plate(tmp_path: Path) -> tuple[Path, np.ndarray]:
    """A lossless clip of one smooth picture at 50 frames per second, and its 8-bit codes, blue first."""
    from tests.support.layer_viewfinder import write_plate

    return write_plate(tmp_path)
