"""mrbokeh: rendered 3D objects in real photographs, with the blur of the real lens.

The public names load on first use, so that `import mrbokeh` stays cheap.
"""

from importlib import import_module
from typing import Any

_PUBLIC = {
    "Aperture": "mrbokeh.optics.aperture",
    "Camera": "mrbokeh.optics.camera",
    "FocalStack": "mrbokeh.stacks.focal_stack",
    "InputError": "mrbokeh.system.errors",
    "Layer": "mrbokeh.images.layer",
    "Lens": "mrbokeh.optics.lens",
    "Psf": "mrbokeh.optics.psf",
    "Renderer": "mrbokeh.renderers.base",
    "composite": "mrbokeh.commands.on_arrays",
    "merge": "capture.merge_photographs",
    "read_focal_stack": "mrbokeh.stacks.focal_stack",
    "read_image": "mrbokeh.images.image_io",
    "read_layer": "mrbokeh.images.image_io",
    "read_lens": "mrbokeh.renderers.choose",
    "read_picture": "mrbokeh.commands.on_arrays",
    "render": "mrbokeh.commands.on_arrays",
    "write_image": "mrbokeh.images.image_io",
    "write_layer": "mrbokeh.images.image_io",
    "write_lens": "mrbokeh.optics.lens_file",
}
__all__ = sorted(_PUBLIC)


def __getattr__(name: str) -> Any:
    if name == "__version__":
        return _version()
    if name not in _PUBLIC:
        raise AttributeError(f"module 'mrbokeh' has no attribute {name!r}")
    return getattr(import_module(_PUBLIC[name]), name)


def __dir__() -> list[str]:
    return [*__all__, "__version__"]


def _version() -> str:
    from importlib.metadata import PackageNotFoundError, version

    try:
        return version("mrbokeh")
    except PackageNotFoundError:
        return "0+unknown"
