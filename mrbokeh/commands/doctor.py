"""`mrbokeh doctor`: what is installed, what is missing, and what it would enable."""

import os
import platform
import shutil
from collections.abc import Callable
from importlib.metadata import PackageNotFoundError, version
from typing import NamedTuple

import typer
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from mrbokeh import __version__

app = typer.Typer(add_completion=False)


class Component(NamedTuple):
    name: str
    found: str | None
    enables: str
    remedy: str


PACKAGES = (
    ("rawpy", "reading RAW photographs", "pip install 'mrbokeh[capture]'"),
    ("pyexiv2", "focus distance, focal length and f-number from photographs", "pip install 'mrbokeh[capture]'"),
    ("exifread", "metadata of photographs that pyexiv2 cannot open", "pip install 'mrbokeh[capture]'"),
    ("lensfunpy", "sensor sizes of cameras that do not state theirs", "pip install 'mrbokeh[capture]'"),
    ("pycolmap", "camera poses and depth from several viewpoints", "pip install 'mrbokeh[capture]'"),
    ("gphoto2", "shooting focal stacks with a tethered camera", "pip install 'mrbokeh[tether]'"),
    ("torch", "training networks", "pip install 'mrbokeh[train]'"),
    ("onnx", "exporting networks", "pip install 'mrbokeh[train]'"),
    ("onnxruntime", "rendering with trained networks", "pip install mrbokeh"),
    ("embreex", "rendering 3D objects", "pip install mrbokeh"),
    ("av", "reading and writing videos", "pip install mrbokeh"),
    ("aiohttp", "the viewfinder in a browser", "pip install 'mrbokeh[viewfinder]'"),
    ("aiortc", "the viewfinder's video stream", "pip install 'mrbokeh[viewfinder]'"),
    ("mitsuba", "path-traced objects, with reflections on the ground", "pip install 'mrbokeh[mitsuba]'"),
    ("pyoidn", "denoising of path-traced objects", "pip install 'mrbokeh[denoise]'"),
    ("opencolorio", "ACES and other colour spaces", "pip install 'mrbokeh[ocio]'"),
    ("distributed", "videos composited by several machines", "pip install 'mrbokeh[cluster]'"),
)
PROGRAMS = (
    ("exiftool", "metadata of more cameras (49 of 54 files are read without it)", "install exiftool with your system's package manager"),
    ("nvidia-smi", "training and rendering on an NVIDIA GPU", "install the GPU driver; everything works without one, slower"),
)
OPENCV = "opencv-contrib-python-headless"
OTHER_OPENCV = ("opencv-python", "opencv-python-headless", "opencv-contrib-python")


@app.command()
def doctor() -> None:
    """Say what is present, what is missing and what it would enable; nothing here is required for `mrbokeh demo` but the packages.

    Example: mrbokeh doctor
    """
    table = Table(title=f"mrbokeh {__version__} on Python {platform.python_version()}, {platform.machine()}, {os.cpu_count()} cores")
    for column in ("what", "found", "enables", "if you want it"):
        table.add_column(column)
    for component in findings():
        table.add_row(
            component.name, component.found or "[yellow]missing[/]", component.enables, "" if component.found else escape(component.remedy)
        )
    Console().print(table)


def findings() -> list[Component]:
    """Every optional thing with its version or path, None where it is missing."""
    packages = [Component(name, _version(name), enables, remedy) for name, enables, remedy in PACKAGES]
    programs = [Component(name, shutil.which(name), enables, remedy) for name, enables, remedy in PROGRAMS]
    return [*packages, _opencv(), _cuda(), _graphics_device(), _llvm(), *programs]


def _version(package: str) -> str | None:
    try:
        return version(package)
    except PackageNotFoundError:
        return None


def _opencv() -> Component:
    """Find other packages of OpenCV beside ours: all write into one folder `cv2`, the last one installed wins."""
    others = [name for name in OTHER_OPENCV if _version(name)]
    remedy = f"pip uninstall -y {' '.join(others)} {OPENCV} && pip install {OPENCV}" if others else "pip install mrbokeh"
    return Component(OPENCV, None if others else _version(OPENCV), "picture files, registration, filters", remedy)


def _cuda() -> Component:
    remedy = "needs an NVIDIA driver and a CUDA build of torch; training works without, slower"
    return Component("CUDA in torch", _quietly(_cuda_device), "training on the GPU", remedy)


def _graphics_device() -> Component:
    remedy = "pip install 'mrbokeh[viewfinder]' and a Vulkan, Metal or Direct3D 12 driver; the ray caster draws without one"
    return Component("graphics device", _quietly(_described_device), "rendering 3D objects on a graphics card", remedy)


def _llvm() -> Component:
    from mrbokeh.scene.mitsuba.mitsuba_tracer import find_llvm

    found = find_llvm()
    return Component("LLVM library", None if found is None else str(found), "Mitsuba's compiler", "Debian: apt install libllvm19")


def _described_device() -> str | None:
    from mrbokeh.scene.choose import described_device
    from mrbokeh.system.errors import InputError

    try:
        return described_device()
    except InputError:
        return None


def _cuda_device() -> str | None:
    import torch

    return torch.cuda.get_device_name(0) if torch.cuda.is_available() else None


def _quietly(question: Callable[[], str | None]) -> str | None:
    """The answer, or None where the library that would know it is missing or broken."""
    try:
        return question()
    except (ImportError, OSError, RuntimeError):
        return None
