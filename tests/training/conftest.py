"""Runs of these tests do without the drawing of their curve, which takes longer than most of the trainings."""

from collections.abc import Iterator

import pytest


@pytest.fixture(autouse=True, scope="session")
def undrawn() -> Iterator[None]:
    """But within `drawn_curves` of tests/support."""
    record = pytest.importorskip("training.fitting.record", exc_type=ImportError)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(record, "draw_curve", lambda _folder, _curve: "<svg></svg>")
        yield
