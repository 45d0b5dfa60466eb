"""What `mrbokeh composite` writes: the picture, or with .exr all that it was put together from."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from mrbokeh.compositing.base import Inserted
from mrbokeh.layer import Layer, flatten
from mrbokeh.plate import Plate


def write_picture(out: Path, inserted: Inserted, plate: Plate, sharp: Sequence[Layer], space: str | None, config: str) -> None:
    """space: of OpenColorIO, in which the picture alone is written; None is linear Rec.709, with layers, or sRGB."""
    from mrbokeh.image_io import write_image

    if space is not None:
        from mrbokeh.color_management import ColorConversion

        write_image(out, ColorConversion.from_rec709(config, space).applied(inserted.rgb), "linear")
    elif out.suffix.lower() == ".exr":
        _write_layers(out, inserted, plate, flatten(sharp))
    else:
        write_image(out, inserted.rgb)


def _write_layers(out: Path, inserted: Inserted, plate: Plate, sharp: Layer) -> None:
    """Depth is that of the frontmost sharp surface; circles of confusion follow from it."""
    from mrbokeh.exr_layers.composite_exr import CompositeLayers, write_composite_exr

    scene_m = np.full(sharp.depth_m.shape, np.inf, np.float32) if plate.depth_m is None else plate.depth_m
    depth_m = np.where(sharp.alpha > 0.5, np.minimum(sharp.depth_m, scene_m), scene_m).astype(np.float32)
    coc_px = plate.lens.coc_px(depth_m, depth_m.shape[1]).astype(np.float32)
    layers = {"virtual": _bare(inserted.virtual), "sharp": _bare(sharp)}
    write_composite_exr(out, CompositeLayers(inserted.rgb, None, depth_m, layers, inserted.virtual.alpha, coc_px))


def _bare(layer: Layer) -> Layer:
    return Layer(layer.rgb, layer.alpha, layer.depth_m)
