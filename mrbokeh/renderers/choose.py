"""A renderer by its name on the command line; the only module that knows them all."""

from collections.abc import Callable
from pathlib import Path

from mrbokeh.errors import InputError
from mrbokeh.renderers.base import Renderer


def _scatter_reference() -> Renderer:
    from mrbokeh.renderers.scatter_reference import ScatterReference

    return ScatterReference()


BY_NAME: dict[str, Callable[[], Renderer]] = {"reference": _scatter_reference}


def make_renderer(name: str) -> Renderer:
    """The renderer of that name, or the network in that .onnx file."""
    if name in BY_NAME:
        return BY_NAME[name]()
    if name.lower().endswith(".onnx"):
        from mrbokeh.renderers.onnx_network import OnnxNetwork

        return OnnxNetwork(Path(name))
    raise InputError(f"expected a renderer ({', '.join(BY_NAME)}) or the path of a network (.onnx), got {name!r}")
