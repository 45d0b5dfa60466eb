"""Clean colours under a soft matte: picture = alpha F + (1 - alpha) B solved for F and B.

Forte, Approximate Fast Foreground Colour Estimation (ICIP 2021): both are local means, then what the mixture leaves over is given
to them; a coarse round finds the colours, a fine one their detail.
"""

import numpy as np
from jaxtyping import Float32

_ROUNDS_PX = (91, 7)
_LEAST = np.float32(1e-5)

Plane = Float32[np.ndarray, "height width"]
Picture = Float32[np.ndarray, "height width 3"]


def clean_colours(picture: Picture, alpha: Plane) -> tuple[Picture, Picture]:
    """(F, B): colours of what the matte (0 to 1) holds and of the rest, unpremultiplied, not below 0; both go on everywhere."""
    front, behind = picture, picture
    share = alpha[..., None]
    for size_px in _ROUNDS_PX:
        front, behind = _mean(front, alpha, size_px), _mean(behind, np.float32(1.0) - alpha, size_px)
        left_over = picture - share * front - (1.0 - share) * behind
        front, behind = np.maximum(front + share * left_over, 0.0), np.maximum(behind + (1.0 - share) * left_over, 0.0)
    return front, behind


def _mean(picture: Picture, weight: Plane, size_px: int) -> Picture:
    from cv2 import blur

    total = blur(weight, (size_px, size_px))
    return blur(picture * weight[..., None], (size_px, size_px)) / (total + _LEAST)[..., None]
