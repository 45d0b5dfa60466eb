"""Clips that several tests of the viewfinder take."""

from pathlib import Path

import numpy as np
import pytest


@pytest.fixture
def plate(tmp_path: Path) -> tuple[Path, np.ndarray]:
    """A lossless clip of one smooth picture at 50 frames per second, and its 8-bit codes, blue first."""
    from tests.scenes.layer_viewfinder import write_plate

    return write_plate(tmp_path)
