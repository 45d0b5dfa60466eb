"""A few of the photographs that travel with the package, made small."""

from functools import cache
from pathlib import Path

import numpy as np

import mrbokeh as mb

DATA = Path(mb.__file__).parent / "demo_data"


def few_small_photographs(folder: Path) -> Path:
    """Write three slices of the shipped focal stack, 256 by 192 px, into a new folder; return it."""
    folder.mkdir()
    for name in ("01.jpg", "04.jpg", "07.jpg"):
        mb.write_image(folder / name, _small(name))
    return folder


@cache
def _small(name: str) -> np.ndarray:
    return np.ascontiguousarray(mb.read_picture(DATA / "pcb_oblique" / name)[::8, ::8])
