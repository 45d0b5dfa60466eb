"""Coverage in stored video frames (PyAV), whatever their format of pixels; FFmpeg brings it into a plane of its own, without loss."""

from typing import Any

import numpy as np
from jaxtyping import Float32


def has_alpha(frame: Any) -> bool:
    """Whether a frame holds coverage, be it opaque everywhere."""
    return any(component.is_alpha for component in frame.format.components)


def stored_alpha(frame: Any) -> Float32[np.ndarray, "height width"]:
    """Of a frame that has some, in [0, 1], the way up in which it is stored; it uses the full range of codes, whatever colour does."""
    bits = next(component.bits for component in frame.format.components if component.is_alpha)
    plane = _with_plane(frame, bits).planes[-1]
    codes = np.frombuffer(plane, np.uint8 if bits == 8 else "<u2").reshape(frame.height, -1)[:, : frame.width]
    return codes / np.float32((1 << bits) - 1)


def _with_plane(frame: Any, bits: int) -> Any:
    """A frame whose last plane is the coverage alone, in little-endian numbers."""
    name, alpha = frame.format.name, frame.format.components[-1]
    if alpha.plane == len(frame.format.components) - 1 and not name.endswith("be"):
        return frame
    planar = "gbrap" if frame.format.is_rgb else "yuva444p"
    return frame.reformat(format=planar if bits == 8 else f"{planar}{bits}le")
