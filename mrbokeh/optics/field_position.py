"""Where pixels lie in the frame: x right, y down from its middle, in half diagonals (CONVENTIONS, "Field position")."""

import numpy as np
from jaxtyping import Float32


def field_positions(
    size_px: tuple[int, int], frame_px: tuple[int, int] | None = None, origin_px: tuple[int, int] = (0, 0)
) -> Float32[np.ndarray, "height width 2"]:
    """(H, W, 2): (x, y) of the centre of every pixel; length 1 is reached in the corner of a corner pixel.

    size_px: (height, width) of the part wanted, whose top left pixel is origin_px (row, column) of a frame of frame_px (height, width);
    None: the part is the whole frame.
    """
    frame_px = frame_px or size_px
    half_diagonal_px = 0.5 * float(np.hypot(*frame_px))
    down, right = (
        (origin + 0.5 + np.arange(length) - 0.5 * whole) / half_diagonal_px
        for length, whole, origin in zip(size_px, frame_px, origin_px, strict=True)
    )
    return np.stack(np.meshgrid(right, down), axis=2).astype(np.float32)
