"""Motion vectors of other programs' renders: EXR channels forward.u (right) and forward.v (up), in pixels of one frame."""

from dataclasses import replace
from pathlib import Path

import numpy as np
from jaxtyping import Float32

from mrbokeh.images.exr_io import read_exr
from mrbokeh.images.layer import Layer
from mrbokeh.layering.motion import with_motion
from mrbokeh.system.errors import InputError

_NAMES = (("forward.u", "forward.v"), ("motion.u", "motion.v"), ("u", "v"))


def read_motion(path: Path | str) -> Float32[np.ndarray, "height width 2"]:
    """Motion in pixels, right and down, as mrbokeh counts; files count upwards, as Nuke and Blender do.

    Raises InputError where there are no such channels.
    """
    channels = {name: pixels for part in reversed(read_exr(path)) for name, pixels in part.channels.items()}
    for right, up in _NAMES:
        if right in channels and up in channels:
            return np.stack([channels[right], -channels[up]], axis=2).astype(np.float32)
    raise InputError(f"{path}: expected motion in the channels forward.u and forward.v, but it has {', '.join(sorted(channels))}")


def taken_from_channels(layer: Layer, shutter: float) -> Layer:
    """The layer with its extra channels forward.u and forward.v, times alpha as all extra channels, as its motion; else unchanged."""
    if not {"forward.u", "forward.v"} <= layer.extra.keys():
        return layer
    alpha = np.maximum(layer.alpha, np.float32(1e-6))[..., None]
    motion_px = np.concatenate([layer.extra["forward.u"], -layer.extra["forward.v"]], axis=2) / alpha
    rest = {name: values for name, values in layer.extra.items() if name not in ("forward.u", "forward.v")}
    return with_motion(replace(layer, extra=rest), motion_px.astype(np.float32), shutter)
