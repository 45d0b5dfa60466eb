"""Sharp layers as a deep EXR, for compositors that hold out and merge by depth: one sample per layer and pixel that holds anything."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from mrbokeh.images.layer import Layer
from mrbokeh.system.atomic_files import atomic_path
from mrbokeh.system.errors import InputError

COMMENTS = "Scene-linear; premultiplied alpha; Z in metres along the optical axis; samples have no thickness. Written by mrbokeh."


def write_deep_exr(path: Path | str, layers: Sequence[Layer], *, half: bool = True) -> None:
    """R, G, B, A in half or float and Z in float; nearest first. Deep pictures are for sharp layers: blurred light has no one depth.

    Who reads it goes by depth alone: where layers are not in the order of their depth, that is what changes.
    """
    import OpenEXR

    sizes = {layer.alpha.shape for layer in layers}
    if len(sizes) != 1:
        raise InputError(f"a deep picture needs layers of one size, got {sorted((w, h) for h, w in sizes) or 'none'} (width, height)")
    dtype = np.float16 if half else np.float32
    rgba = np.stack([np.dstack([layer.rgb, layer.alpha]) for layer in layers])
    depth_m = np.stack([layer.depth_m for layer in layers])
    which, rows, columns = np.nonzero((rgba != 0).any(axis=3))
    order = np.lexsort((which, depth_m[which, rows, columns], columns, rows))
    which, rows, columns = which[order], rows[order], columns[order]
    # Where a pixel's samples begin.
    begins = np.flatnonzero(np.diff(rows, prepend=-1) | np.diff(columns, prepend=-1))
    values = {name: rgba[which, rows, columns, i].astype(dtype) for i, name in enumerate("RGBA")} | {"Z": depth_m[which, rows, columns]}
    planes = {name: np.full(depth_m.shape[1:], None, object) for name in values}
    for name, of_samples in values.items():
        for y, x, samples in zip(rows[begins], columns[begins], np.split(of_samples, begins[1:]), strict=True):
            planes[name][y, x] = samples
    header = {"type": OpenEXR.deepscanline, "compression": OpenEXR.ZIPS_COMPRESSION, "comments": COMMENTS}
    with atomic_path(path) as temporary:
        OpenEXR.File([OpenEXR.Part(header, planes, "rgba")]).write(str(temporary))
