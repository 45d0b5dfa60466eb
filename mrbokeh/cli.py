"""`mrbokeh`: one typer app; the package behind a sub-command is imported when it is called, not before."""

import errno
import os
import signal
import sys
import tempfile
import traceback
from contextlib import suppress
from importlib import import_module
from pathlib import Path
from types import FrameType
from typing import Any, NamedTuple

import typer
from rich.console import Console
from typer.core import TyperGroup
from typer.main import get_command

from mrbokeh.system.errors import FAULT, INTERRUPTED, InputError, MissingExtraError

# OpenCV's threads otherwise spin while they wait for work: a tenth of the CPU time of a merge. It is read when OpenCV is imported.
os.environ.setdefault("OPENCV_THREAD_POOL_ACTIVE_WAIT_WORKER", "0")

# Where a module can be missing because its extra was not installed.
EXTRA_OF_MODULE = {
    "rawpy": "capture",
    "pyexiv2": "capture",
    "exifread": "capture",
    "lensfunpy": "capture",
    "pycolmap": "capture",
    "gphoto2": "tether",
    "torch": "train",
    "onnx": "train",
    "onnxscript": "train",
    "aiohttp": "viewfinder",
}


class SubCommand(NamedTuple):
    module: str
    summary: str


SUB_COMMANDS = {
    "capture": SubCommand("capture.cli", "Photographs at many focus distances become an all-in-focus image with depth."),
    "train": SubCommand("training.cli", "Train a network that reproduces the blur of one lens."),
    "lens": SubCommand("mrbokeh.commands.lens", "Make, inspect and draw lens files and banks of PSFs."),
    "render": SubCommand("mrbokeh.commands.render", "Blur layers as a lens does."),
    "composite": SubCommand("mrbokeh.commands.composite", "Put virtual objects into a photograph."),
    "video": SubCommand("mrbokeh.commands.video", "Put virtual objects into a video."),
    "refocus": SubCommand("mrbokeh.commands.refocus", "New slices of a focal stack, between and beyond the captured ones."),
    "transfer": SubCommand("mrbokeh.commands.transfer", "Put a lens on an all-in-focus photograph with a depth map."),
    "check": SubCommand("mrbokeh.commands.check", "Find what is wrong in composites: NaN, leaks, lost light, flicker."),
    "track": SubCommand("mrbokeh.commands.track", "The camera of every frame of a clip, and its files."),
    "viewfinder": SubCommand("viewfinder.cli", "Stream a camera with virtual objects in it to a browser."),
    "blender-addon": SubCommand("mrbokeh.commands.blender_addon", "Write the add-on that exports scenes from Blender."),
    "demo": SubCommand("mrbokeh.commands.demo", "The whole pipeline on shipped photographs, with a report."),
    "doctor": SubCommand("mrbokeh.commands.doctor", "What is installed, what is missing, and what it would enable."),
}


def _placeholder(name: str, summary: str) -> Any:
    """Return a command that stands in the list for one that is not loaded."""
    app = typer.Typer(add_completion=False)
    app.command(name, help=summary)(lambda: None)
    return get_command(app)


class LazyGroup(TyperGroup):
    """A group that loads a sub-command's module when the sub-command is called (or completed, or asked for help)."""

    def __init__(self, **settings: Any) -> None:
        super().__init__(**settings)
        self.commands = {name: _placeholder(name, each.summary) for name, each in SUB_COMMANDS.items()}

    def resolve_command(self, ctx: Any, args: list[str]) -> Any:
        name, command, rest = super().resolve_command(ctx, args)
        if name in SUB_COMMANDS:
            command = get_command(import_module(SUB_COMMANDS[name].module).app)
            command.name = name
        return name, command, rest


app = typer.Typer(
    cls=LazyGroup, no_args_is_help=True, pretty_exceptions_enable=False, context_settings={"help_option_names": ["-h", "--help"]}
)


def _print_version(wanted: bool | None) -> None:
    if wanted:
        from mrbokeh import __version__

        typer.echo(f"mrbokeh {__version__}")
        raise typer.Exit


@app.callback()
def _root(
    version: bool | None = typer.Option(None, "--version", callback=_print_version, is_eager=True, help="Print the version and leave."),
    debug: bool = typer.Option(False, "--debug", help="First of all options: show the traceback of a fault of mrbokeh itself."),
) -> None:
    """Rendered 3D objects in real photographs, videos and a live viewfinder, with the blur of the real lens.

    Example: mrbokeh demo --out demo_out
    """


def main() -> None:
    """Run the console script: mistakes of the user end in one sentence and exit code 2, faults of ours in one and exit code 1."""
    interrupted = _noted_interrupts()
    try:
        app()
    except Exception as error:
        mistake = _mistake(error)
        if mistake:
            _fail(mistake)
        if interrupted:
            sys.exit(INTERRUPTED)
        if sys.argv[1:2] == ["--debug"]:
            raise
        _fail(_fault(error), FAULT)


def _mistake(error: Exception) -> str:
    """Return the sentence for an error that the user can mend, else ""."""
    if isinstance(error, InputError):
        return str(error)
    if isinstance(error, ModuleNotFoundError):
        extra = EXTRA_OF_MODULE.get((error.name or "").partition(".")[0])
        return str(MissingExtraError(str(error.name), extra)) if extra else ""
    if isinstance(error, RuntimeError) and "Symlink loop" in str(error):
        return f"{str(error).partition(' from ')[2]} is a link that leads back to itself: name the file that is meant"
    if isinstance(error, MemoryError):
        return "there is not enough memory for this: use smaller pictures (--max-width where there is one) or fewer at once"
    if isinstance(error, OSError) and error.errno in (errno.ENOSPC, errno.EDQUOT):
        return "there is no space left where this was written, or in the temporary folder: free some and run the same command again"
    if isinstance(error, OSError) and isinstance(error.filename, str | bytes):
        return _refused(error)
    return ""


def _fault(error: Exception) -> str:
    """Keep the traceback in a file, where one can be written, and return what to do with it."""
    kept, text = "`mrbokeh --debug ...`", " ".join(sys.argv) + "\n\n" + "".join(traceback.format_exception(error))
    with suppress(OSError), tempfile.NamedTemporaryFile("wb", prefix="mrbokeh-fault-", suffix=".txt", delete=False) as file:
        file.write(text.encode("utf-8", "backslashreplace"))
        kept = file.name
    first = (str(error).splitlines() or [""])[0]
    return (
        f"this is a fault of mrbokeh ({type(error).__name__}{': ' + first if first else ''}). "
        f"Please report it with {kept}; `mrbokeh --debug ...` shows it here"
    )


def _noted_interrupts() -> list[int]:
    """Return a list that fills with interrupts. Ctrl-C raises KeyboardInterrupt, but compilers may turn that into another error."""
    noted: list[int] = []

    def note(number: int, frame: FrameType | None) -> None:
        noted.append(number)
        signal.default_int_handler(number, frame)

    if signal.getsignal(signal.SIGINT) is signal.default_int_handler:
        signal.signal(signal.SIGINT, note)
    return noted


def _refused(error: OSError) -> str:
    """Describe what the system refused to do with a file or folder; for a temporary file, name its folder."""
    path = Path(os.fsdecode(error.filename))
    shown = path.parent if path.name.startswith(".") and ".part" in path.name else path
    if isinstance(error, FileNotFoundError):
        return f"{shown}: there is no such file or folder: check the name"
    if isinstance(error, IsADirectoryError):
        return f"{shown} is a folder (it is a directory), but a file was expected there: check the name"
    if isinstance(error, NotADirectoryError | FileExistsError):
        return f"{shown}: a file is where a folder was expected: check the name"
    return f"{shown}: {(error.strerror or 'the system refused it').lower()}; check the name, the space left and who may write there"


def _fail(message: str, code: int = 2) -> None:
    console = Console(stderr=True, soft_wrap=True)
    console.print("error:", style="bold red", end=" ")
    console.print(message, markup=False, highlight=False)
    sys.exit(code)


if __name__ == "__main__":
    main()
