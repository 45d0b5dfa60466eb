"""Choice of the backend that renders virtual objects on this machine."""

import sys
from pathlib import Path

from mrbokeh.scene.embree.embree_raycaster import EmbreeRaycaster
from mrbokeh.scene.mitsuba.mitsuba_tracer import MitsubaTracer
from mrbokeh.scene.wgpu.device import gpu
from mrbokeh.scene.wgpu.wgpu_rasterizer import WgpuRasterizer
from mrbokeh.system.errors import InputError


def scene_renderer(name: str = "auto", threads: int = 0) -> EmbreeRaycaster | WgpuRasterizer | MitsubaTracer:
    """A renderer by name; threads: of the ray caster and the path tracer, 0 takes all.

    "auto" takes the graphics card where there is one, and the ray caster otherwise. Mesa's device in software
    is taken only when asked for by "wgpu", path tracing only by "mitsuba". Raises InputError where the device or
    the package asked for is missing.
    """
    if name not in ("auto", "wgpu", "embree", "mitsuba"):
        raise InputError(f"expected the scene renderer mitsuba, auto, wgpu or embree, got {name!r}")
    if name == "mitsuba":
        return MitsubaTracer(threads=threads)
    if name == "embree" or (name == "auto" and not has_graphics_card()):
        return EmbreeRaycaster(threads=threads)
    return WgpuRasterizer()


_LINUX_DEVICES = ("dri/renderD*", "nvidia[0-9]*", "dxg", "kfd")
"""Files below /dev of which a machine with a graphics card has one: Mesa's drivers, NVIDIA's, Windows' for its Linux, AMD's."""


def has_graphics_card() -> bool:
    """Return whether wgpu finds a device other than the processor itself; to ask it takes 0.6 s, where there may be one."""
    if sys.platform == "linux" and not any(any(Path("/dev").glob(name)) for name in _LINUX_DEVICES):
        return False
    try:
        return not gpu().is_software
    except InputError:
        return False


def described_device() -> str:
    """The graphics device in words, for `mrbokeh doctor`; raises InputError where there is none."""
    device = gpu()
    return f"{device.name}, in software: the ray caster is taken" if device.is_software else device.name
