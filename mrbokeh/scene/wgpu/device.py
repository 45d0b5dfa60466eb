"""The graphics device that wgpu finds (Vulkan, Metal or Direct3D 12; also Mesa's in software), with its buffers and textures."""

from dataclasses import dataclass
from functools import cache
from importlib import resources
from os import environ
from tempfile import gettempdir
from typing import Any

import numpy as np

from mrbokeh.system.errors import InputError, MissingExtraError

_WANTED_LIMITS = (
    "max-buffer-size",
    "max-storage-buffer-binding-size",
    "max-storage-buffers-per-shader-stage",
    "max-texture-dimension-2d",
    "max-texture-array-layers",
)
_STORAGE_BUFFERS = 10
"""As many as the shading binds; WebGPU itself promises eight, the devices of desktop computers have more."""


@dataclass(frozen=True, eq=False)
class Gpu:
    """A device and its name; is_software: it computes on the processor (Mesa's llvmpipe)."""

    device: Any
    name: str
    is_software: bool

    def buffer(self, values: np.ndarray, usage: str = "STORAGE") -> Any:
        """A buffer that holds an array (one element at least, as empty buffers do not exist)."""
        data = np.ascontiguousarray(values)
        size = -(-max(data.nbytes, 16) // 16) * 16
        buffer = self.empty_buffer(size, usage)
        if data.nbytes:
            self.write(buffer, data)
        return buffer

    def empty_buffer(self, size_bytes: int, usage: str = "STORAGE") -> Any:
        limit = self.device.limits["max-storage-buffer-binding-size"]
        if usage == "STORAGE" and size_bytes > limit:
            raise InputError(
                f"this scene needs {size_bytes >> 20} MB in one piece, but the graphics device {self.name} takes {limit >> 20} MB: "
                "use fewer triangles or a smaller panorama, or the ray caster"
            )
        flags = {"STORAGE": "STORAGE|COPY_DST|COPY_SRC", "UNIFORM": "UNIFORM|COPY_DST", "INDIRECT": "INDIRECT|COPY_DST"}[usage]
        return self.device.create_buffer(size=size_bytes, usage=flags)

    def write(self, buffer: Any, values: np.ndarray) -> None:
        data = np.ascontiguousarray(values)
        self.device.queue.write_buffer(buffer, 0, data.tobytes() if data.nbytes % 4 else data)

    def read(self, buffer: Any, dtype: type, count: int, first: int = 0) -> np.ndarray:
        """Elements of a buffer (of four bytes each or a multiple), once the device is done."""
        size = np.dtype(dtype).itemsize
        return np.frombuffer(self.device.queue.read_buffer(buffer, first * size, count * size), dtype, count)

    def texture(self, size: tuple[int, int, int], texel: str, samples: int = 1, usage: str = "RENDER_ATTACHMENT|TEXTURE_BINDING") -> Any:
        """Create a texture. size: width, height, layers; texel: the format's name in WebGPU."""
        return self.device.create_texture(size=size, format=texel, sample_count=samples, usage=usage)

    def shader(self, *names: str) -> Any:
        """A module of the named WGSL files, one after the other."""
        folder = resources.files("mrbokeh.scene.wgpu") / "shaders"
        return self.device.create_shader_module(code="\n".join((folder / f"{name}.wgsl").read_text("utf-8") for name in names))

    def layout(self, stages: str, *kinds: dict[str, Any] | None) -> Any:
        """A bind group's layout: what lies at binding 0, 1, ...; None leaves one out."""
        entries = [{"binding": index, "visibility": stages, **kind} for index, kind in enumerate(kinds) if kind is not None]
        return self.device.create_bind_group_layout(entries=entries)

    def bound(self, layout: Any, *things: Any) -> Any:
        """A bind group of buffers and texture views in the order of the layout's bindings."""
        entries = [
            {"binding": index, "resource": {"buffer": thing} if hasattr(thing, "map_state") else thing}
            for index, thing in enumerate(things)
            if thing is not None
        ]
        return self.device.create_bind_group(layout=layout, entries=entries)


READ_ONLY = {"buffer": {"type": "read-only-storage"}}
WRITABLE = {"buffer": {"type": "storage"}}
UNIFORM = {"buffer": {"type": "uniform"}}


def sampled(kind: str, dimension: str = "2d", multisampled: bool = False) -> dict[str, Any]:
    """A texture to read from: kind is 'uint', 'depth' or 'unfilterable-float'."""
    return {"texture": {"sample_type": kind, "view_dimension": dimension, "multisampled": multisampled}}


@cache
def gpu() -> Gpu:
    """The fastest device of this machine. Raises InputError where there is none, MissingExtraError without wgpu."""
    # Without a place for sockets its library complains of an error on every start, though it needs none here.
    environ.setdefault("XDG_RUNTIME_DIR", gettempdir())
    try:
        import wgpu
    except ImportError as missing:
        raise MissingExtraError("wgpu", "viewfinder") from missing
    try:
        adapter = wgpu.gpu.request_adapter_sync(power_preference="high-performance")
    except RuntimeError as none:
        raise _no_device() from none
    if adapter is None or adapter.info["backend_type"] == "OpenGL":
        raise _no_device()
    if adapter.limits["max-storage-buffers-per-shader-stage"] < _STORAGE_BUFFERS:
        raise _no_device()
    device = adapter.request_device_sync(required_limits={name: adapter.limits[name] for name in _WANTED_LIMITS})
    return Gpu(device, adapter.info["device"], adapter.info["adapter_type"] == "CPU")


def _no_device() -> InputError:
    return InputError(
        "expected a graphics device with Vulkan, Metal or Direct3D 12, found none: install its driver "
        "(or Debian's mesa-vulkan-drivers, in software), or use the ray caster"
    )
