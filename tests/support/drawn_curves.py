"""The curves of trainings, drawn as users see them: runs in tests/training do without (its conftest.py)."""

from collections.abc import Iterator
from contextlib import contextmanager

import pytest

from training.fitting import checkpoint, record


@contextmanager
def drawn_curves() -> Iterator[None]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(record, "draw_curve", checkpoint.draw_curve)
        yield
