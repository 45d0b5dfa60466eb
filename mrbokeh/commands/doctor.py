"""`mrbokeh doctor`: what is installed, what is missing, and what it would enable; with --compile, all kernels ahead of their use."""

import os
import platform
import shutil
import signal
import subprocess
import sys
import tempfile
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from threading import Timer
from typing import Annotated, NamedTuple

import typer
from rich.markup import escape
from rich.table import Table

from mrbokeh import __version__
from mrbokeh.demo.plan import DATA
from mrbokeh.system.console import progress_bars
from mrbokeh.system.errors import InputError, install_command
from mrbokeh.system.messages import show, tell

app = typer.Typer(add_completion=False)


class Component(NamedTuple):
    name: str
    found: str | None
    enables: str
    remedy: str


PACKAGES = (
    ("rawpy", "reading RAW photographs", "capture"),
    ("pyexiv2", "focus distances, and all that XMP and makers' notes say of photographs", "capture"),
    ("exifread", "focal length and f-number from photographs", ""),
    ("lensfunpy", "sensor sizes of cameras that do not state theirs", "capture"),
    ("pycolmap", "camera poses and depth from several viewpoints", "capture"),
    ("gphoto2", "shooting focal stacks with a tethered camera", "tether"),
    ("torch", "training networks", "train"),
    ("onnx", "exporting networks", "train"),
    ("onnxruntime", "rendering with trained networks", ""),
    ("embreex", "rendering 3D objects", ""),
    ("av", "reading and writing videos", ""),
    ("aiohttp", "the viewfinder in a browser", "viewfinder"),
    ("aiortc", "the viewfinder's video stream", "viewfinder"),
    ("mitsuba", "path-traced objects, with reflections on the ground", "mitsuba"),
    ("pyoidn", "denoising of path-traced objects", "denoise"),
    ("opencolorio", "ACES and other colour spaces", "ocio"),
    ("pi-heif", "reading HEIC photographs of phones, with their depth", "heic"),
    ("distributed", "videos composited by several machines", "cluster"),
)
PROGRAMS = (
    ("exiftool", "metadata of more cameras (49 of 54 files are read without it)", "install exiftool with your system's package manager"),
    ("nvidia-smi", "training and rendering on an NVIDIA GPU", "install the GPU driver; everything works without one, slower"),
)
_TRUTH, _STACK = DATA / "raw_stack" / "truth" / "view_0", Path("scene") / "pcb_oblique"
_BLUR = ("--depth", str(_TRUTH / "depth.exr"), "--lens", "lens.json")
_PUT_IN = ("--object", str(DATA / "objects" / "alien.glb"), "--at-pixel", "100,150", "--height", "60px", "--shadow", "0.5")
WORK = (
    (
        ("lens", "new", "lens.json", "--focal-length", "50", "--f-number", "1.8", "--focus", "0.8"),
        *(
            ("render", "--rgb", str(_TRUTH / "all_in_focus.exr"), *_BLUR, "--renderer", method, "--out", f"{method}.exr")
            for method in ("polygon", "laplacian", "low-rank", "scatter")
        ),
        ("transfer", str(_TRUTH / "all_in_focus.exr"), *_BLUR, "--focus", "0.8", "--out", "transferred.png"),
        ("render", "--rgb", str(DATA / "pcb_oblique" / "04.jpg"), "--srgb", "--depth", "4", "--focus", "0.8", "--out", "larger.exr"),
    ),
    (
        ("capture", "process", str(DATA / "pcb_oblique"), "--max-width", "320", "--out", "scene"),
        ("composite", str(_STACK), "--slice", "2", *_PUT_IN, "--out", "between.png"),
        ("composite", str(_STACK), "--slice", "2", *_PUT_IN, "--mode", "over", "--grain", "auto", "--out", "over.png"),
        ("refocus", str(_STACK), "--focus", "@100,100", "--out", "refocused"),
    ),
    (("viewfinder", "--demo", "--port", "0"),),
)
"""Commands that need nearly all kernels: rows that run side by side, the last only where its extra is installed. A larger picture takes
single precision."""
SHOWN = "the scene is shown"
_MOST_TOLD, _LONGEST_S = 500, 900.0
OPENCV = "opencv-contrib-python-headless"
OTHER_OPENCV = ("opencv-python", "opencv-python-headless", "opencv-contrib-python")


@app.command()
def doctor(
    compile_all: Annotated[bool, typer.Option("--compile", help="Compile now what commands need, so that none waits later.")] = False,
) -> None:
    """Say what is present, what is missing and what it would enable; nothing here is required for `mrbokeh demo` but the packages.

    Example: mrbokeh doctor
    """
    if compile_all:
        compile_kernels()
        return
    table = Table(title=f"mrbokeh {__version__} on Python {platform.python_version()}, {platform.machine()}, {os.cpu_count()} cores")
    for column in ("what", "found", "enables"):
        table.add_column(column)
    components = findings()
    for component in components:
        table.add_row(component.name, escape(component.found or "") or "[yellow]missing[/]", component.enables)
    show(table, components=[component._asdict() for component in components])
    for component in components:
        if not component.found:
            tell(f"{component.name}: {component.remedy}")


def findings() -> list[Component]:
    """Every optional thing with its version or path, None where it is missing."""
    packages = [Component(name, _version(name), enables, install_command(extra)) for name, enables, extra in PACKAGES]
    programs = [Component(name, shutil.which(name), enables, remedy) for name, enables, remedy in PROGRAMS]
    return [*packages, _opencv(), _cuda(), _graphics_device(), _llvm(), _kernels(), *programs]


def compile_kernels() -> None:
    """Run WORK in a temporary folder. Raises InputError where one of its commands fails."""
    rows = WORK if _version("aiohttp") and _version("aiortc") else WORK[:-1]
    with tempfile.TemporaryDirectory() as folder, progress_bars() as progress:
        task = progress.add_task("compiling, once for this machine", total=sum(map(len, rows)))

        def run(row: tuple[tuple[str, ...], ...]) -> None:
            for arguments in row:
                _run(arguments, folder)
                progress.advance(task)

        with ThreadPoolExecutor(len(rows)) as pool:
            list(pool.map(run, rows))


def _run(arguments: tuple[str, ...], folder: str) -> None:
    """Run a command of mrbokeh; one that goes on for ever is interrupted as soon as it says SHOWN."""
    command, environment = [sys.executable, "-m", "mrbokeh.cli", *arguments], os.environ | {"PYTHONSAFEPATH": "1"}
    with subprocess.Popen(command, cwd=folder, env=environment, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True) as process:
        assert process.stdout is not None
        late = Timer(_LONGEST_S, process.kill)
        late.start()
        told = ""
        for line in process.stdout:
            told = (told + line)[-_MOST_TOLD:]
            if line.startswith(SHOWN):
                process.send_signal(signal.SIGINT)
        late.cancel()
    if process.returncode:
        raise InputError(f"`mrbokeh {' '.join(arguments)}` should have worked, but did not: {told.strip()}")


def _kernels() -> Component:
    """Count the modules of kernels that have compiled ones here, or came with them."""
    from mrbokeh.system import compiled

    root = Path(__file__).resolve().parents[2]
    sources = [path for package in ("mrbokeh", "capture", "viewfinder") for path in (root / package).rglob("*_numba.py")]
    folders = [compiled.folder_of(path, ".".join(path.relative_to(root).with_suffix("").parts)) for path in sources]
    ready = sum(folder is not None and any(folder.glob("*.nbc")) for folder in folders)
    found = f"{ready / len(folders):.0%} of them; the rest when first needed" if 0 < ready < len(folders) else ("all" if ready else None)
    return Component("parts compiled for this machine", found, "commands that begin at once", "mrbokeh doctor --compile")


def _version(package: str) -> str | None:
    try:
        return version(package)
    except PackageNotFoundError:
        return None


def _opencv() -> Component:
    """Find other packages of OpenCV beside ours: all write into one folder `cv2`, the last one installed wins."""
    others = [name for name in OTHER_OPENCV if _version(name)]
    remedy = f"pip uninstall -y {' '.join(others)} {OPENCV} && pip install {OPENCV}" if others else install_command()
    return Component(OPENCV, None if others else _version(OPENCV), "picture files, registration, filters", remedy)


def _cuda() -> Component:
    remedy = "needs an NVIDIA driver and a CUDA build of torch; training works without, slower"
    return Component("CUDA in torch", _quietly(_cuda_device), "training on the GPU", remedy)


def _graphics_device() -> Component:
    remedy = f"{install_command('viewfinder')} and a Vulkan, Metal or Direct3D 12 driver; the ray caster draws without one"
    return Component("graphics device", _quietly(_described_device), "rendering 3D objects on a graphics card", remedy)


def _llvm() -> Component:
    from mrbokeh.scene.mitsuba.mitsuba_tracer import find_llvm

    found = find_llvm()
    return Component("LLVM library", None if found is None else str(found), "Mitsuba's compiler", "Debian: apt install libllvm19")


def _described_device() -> str | None:
    from mrbokeh.scene.choose import described_device

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
