"""Reads back what `write_composite_exr` wrote."""

from pathlib import Path

from mrbokeh.images.exr_io import ExrPart, read_exr
from mrbokeh.images.layer import Layer
from mrbokeh.stacks.exr_layers.composite_exr import CompositeLayers
from mrbokeh.system.errors import InputError


def read_composite_exr(path: Path | str) -> CompositeLayers:
    """Return the layers as stored, without converting stated primaries."""
    part = read_exr(path)[0]
    if "mrbokehLayers" not in part.attributes:
        raise InputError(f"{path}: expected a layered EXR of mrbokeh; `FlatRender` reads those of other programs")
    names = [name for name in str(part.attributes["mrbokehLayers"]).split(",") if name]
    layers = {name: _layer(part, name) for name in names}
    maps = {key: part.stacked([name])[..., 0] for key, name in _MAPS.items() if name in part.channels}
    return CompositeLayers(part.stacked("RGB"), layers=layers, **maps)


_MAPS = {"alpha": "A", "depth_m": "Z", "matte": "matte.A", "coc_px": "coc.px"}


def _layer(part: ExrPart, name: str) -> Layer:
    values = part.stacked([f"{name}.{each}" for each in "RGBAZ"])
    return Layer(values[..., :3], values[..., 3], values[..., 4])
