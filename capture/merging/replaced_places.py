"""Places of a merged stack that are said to lie in another slice: what depth.exr says of them then."""

from collections.abc import Mapping

import numpy as np
from jaxtyping import Bool, Float, Float32

from mrbokeh.stacks.focal_stack import FocalStack
from mrbokeh.stacks.guessed_metres import POSITION, POSITION_ERROR, SLICE_POSITION, SLICE_POSITION_ERROR

_OF_SLICES = {POSITION: SLICE_POSITION, POSITION_ERROR: SLICE_POSITION_ERROR}
_LEAST_DIOPTRES = 1e-6

Plane = Float32[np.ndarray, "height width"]
Channels = dict[str, Float[np.ndarray, "height width"]]


def depth_m_of(stack: FocalStack, focus_index: Plane) -> Plane | None:
    """Return the focus index in metres, interpolated in dioptres; None where a focus distance is unknown."""
    if not stack.is_metric:
        return None
    dioptres = [1.0 / distance for distance in stack.focus_distances_m if distance is not None]
    interpolated = np.interp(focus_index, np.arange(len(stack)), dioptres)
    return (1.0 / np.maximum(interpolated, _LEAST_DIOPTRES)).astype(np.float32)


def replaced_depth(
    stack: FocalStack,
    channels: Mapping[str, Float[np.ndarray, "height width"]],
    index: Plane,
    confidence: Plane,
    where: Bool[np.ndarray, "height width"],
) -> Channels:
    """Return the channels of depth.exr with another focus index and confidence in some places, and all that follows from the index."""
    new: dict[str, Plane | None] = {"focus_index": index, "confidence": confidence, "Z": depth_m_of(stack, index)}
    for channel, key in _OF_SLICES.items():
        values = [each.metadata.get(key) for each in stack.slices]
        known = channel in channels and None not in values
        new[channel] = np.interp(index, np.arange(len(stack)), np.array(values, float)).astype(np.float32) if known else None
    changed = {name: np.where(where, plane, channels[name]) for name, plane in new.items() if plane is not None and name in channels}
    return dict(channels) | changed
