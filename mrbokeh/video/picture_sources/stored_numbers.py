"""The numbers of a picture as its file stores them, for a colour space that the user names."""

from pathlib import Path

import numpy as np
from jaxtyping import Float32

from mrbokeh.images.exr_io import read_exr
from mrbokeh.images.image_io import read_image


def read_numbers(path: Path) -> Float32[np.ndarray, "height width 3"]:
    """Integers as 0 to 1 without a curve; EXR without regard to the primaries that it states."""
    return read_exr(path)[0].stacked("RGB") if path.suffix.lower() == ".exr" else read_image(path, "linear")
