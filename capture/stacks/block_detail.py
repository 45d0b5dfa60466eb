"""Fine detail of pictures, block by block: what tells copies of a photograph, and how sharp a merged picture is beside its slices.

Callers choose how light is encoded, and which blocks count.
"""

import numpy as np
from jaxtyping import Float32

BLOCK_PX = 24
DETAIL_SIGMA_PX = 1.5

Plane = Float32[np.ndarray, "height width"]
Blocks = Float32[np.ndarray, "rows columns"]


def detail_of_blocks(plane: Plane) -> Blocks:
    """Return the root mean square of what a Gaussian of DETAIL_SIGMA_PX takes from each block (see `block_means`)."""
    import cv2

    fine = cv2.subtract(plane, cv2.GaussianBlur(plane, (0, 0), DETAIL_SIGMA_PX))
    return np.sqrt(block_means(cv2.multiply(fine, fine)))


def block_means(plane: Plane) -> Blocks:
    """Return means over blocks of BLOCK_PX; what is left at the right and below is cut off, and a smaller plane is one block."""
    import cv2

    rows, columns = (max(side // BLOCK_PX, 1) for side in plane.shape)
    return cv2.resize(plane[: rows * BLOCK_PX, : columns * BLOCK_PX], (columns, rows), interpolation=cv2.INTER_AREA)
