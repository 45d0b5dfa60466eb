"""A renderer by its name on the command line; the only module that knows them all."""

from collections.abc import Callable
from pathlib import Path

from mrbokeh.errors import InputError
from mrbokeh.lens import Lens
from mrbokeh.lens_file import read_lens
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


def lens_and_renderer(lens: Path | None, renderer: str | None) -> tuple[Lens | None, Renderer]:
    """What `--lens` and `--renderer` mean together: a network brings its lens, a lens file is rendered by the reference."""
    if lens is not None and lens.suffix.lower() == ".onnx":
        from mrbokeh.renderers.onnx_network import OnnxNetwork

        network = OnnxNetwork(lens)
        return network.lens, network if renderer is None else make_renderer(renderer)
    return None if lens is None else read_lens(lens), make_renderer(renderer or "reference")
