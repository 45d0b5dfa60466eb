"""`mrbokeh`: one typer app; the package behind a sub-command is imported when it is called, not before."""

import os
import signal
import sys
from collections.abc import Callable
from contextlib import ExitStack, redirect_stderr, suppress
from importlib import import_module
from pathlib import Path
from threading import Lock, Timer
from types import FrameType
from typing import Annotated, Any, NamedTuple

import typer
from rich.console import Console
from typer._click.exceptions import NoArgsIsHelpError
from typer.core import TyperGroup
from typer.main import get_command

from mrbokeh.commands._option_words import with_words
from mrbokeh.system.atomic_files import writing_alone
from mrbokeh.system.console import begin
from mrbokeh.system.errors import FAULT, INTERRUPTED, InputError, fault_in, mistake_in
from mrbokeh.system.messages import channel, end_spinner, object_on_stdout, opened, remove_unfinished, write_object

# OpenCV's threads otherwise spin while they wait for work: a tenth of the CPU time of a merge. It is read when OpenCV is imported.
os.environ.setdefault("OPENCV_THREAD_POOL_ACTIVE_WAIT_WORKER", "0")
# OpenBLAS' threads spin as well, beside threads of ours that share the work already: `lens fit` of 17 slices took 184 CPU s with them
# and 65 without, a composite 2.2 and 1.7. It is read when NumPy is imported.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

EVERY = "Every command"
SHARING = ("video",)
"""Commands that may write one result together: they claim parts of it (`mrbokeh.shots.claims`)."""
SPEAK_FOR_THEMSELVES = {"viewfinder", "studio", "serve", "shoot", "demo", "doctor", "--quiet", "--help", "-h"}
"""Commands that go on until they are stopped, ask for keys or start others, and what asks for no more words: no spinner turns."""
LATEST_S = 1.5
"""Time from Ctrl-C to the end of the process at the latest."""


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
    "tilt-shift": SubCommand("mrbokeh.commands.tilt_shift", "Blur a photograph away from a line, as a tilted lens does."),
    "dataset": SubCommand("mrbokeh.commands.dataset", "Focal stacks for research, computed from a folder of pictures with depth."),
    "check": SubCommand("mrbokeh.commands.check", "Find what is wrong in composites: NaN, leaks, lost light, flicker."),
    "track": SubCommand("mrbokeh.commands.track", "The camera of every frame of a clip, and its files."),
    "viewfinder": SubCommand("viewfinder.cli", "Stream a camera with virtual objects in it to a browser."),
    "studio": SubCommand("viewfinder.studio.cli", "Place an object in a photograph in the browser."),
    "serve": SubCommand("mrbokeh.commands.serve", "Blur for compositors on this machine, with everything warm."),
    "host": SubCommand("mrbokeh.commands.host", "Write what blurs inside Blender, Nuke, Natron or Fusion."),
    "demo": SubCommand("mrbokeh.commands.demo", "The whole pipeline on shipped photographs, with a report."),
    "doctor": SubCommand("mrbokeh.commands.doctor", "What is installed, what is missing, and what it would enable."),
}


def _placeholder(name: str, summary: str) -> Any:
    """Return a command that stands in the list for one that is not loaded."""
    app = typer.Typer(add_completion=False)
    app.command(name, help=summary)(lambda: None)
    return get_command(app)


_every = typer.Typer(add_completion=False)


@_every.command()
def _options_of_every_command(
    quiet: Annotated[bool, typer.Option("--quiet", help="Say only errors and the result.", rich_help_panel=EVERY)] = False,
    as_json: Annotated[
        bool, typer.Option("--json", help="Print one JSON object of what was done; words go to standard error.", rich_help_panel=EVERY)
    ] = False,
    log: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Append all that is said to FILE, with times.", rich_help_panel=EVERY)
    ] = None,
) -> None: ...


def command_of(name: str) -> Any:
    """Load the sub-command of that name; it and what lies in it have the options of every command."""
    command = get_command(import_module(SUB_COMMANDS[name].module).app)
    command.name = name
    _heard(command, name)
    return command


def _heard(command: Any, path: str) -> None:
    """Give a command and what lies in it the options of every command, and let it speak through the channel."""
    for name, each in getattr(command, "commands", {}).items():
        _heard(each, f"{path} {name}")
    if hasattr(command, "commands") and not command.invoke_without_command:
        return
    callback = command.callback
    with_words(command, path)
    command.params = [*command.params, *get_command(_every).params]

    def run(quiet: bool, as_json: bool, log: Path | None, **given: Any) -> None:  # noqa: ARG001
        speaking = channel()
        paths: dict[str, Any] = {}
        for parameter in (each for each in command.params if each.name in given):
            value = given[parameter.name]
            named = [each for each in (value if isinstance(value, list | tuple) else [value]) if isinstance(each, Path)]
            if log is not None and os.path.realpath(log) in map(os.path.realpath, named):
                option = parameter.opts[0] if parameter.opts[0].startswith("-") else parameter.name.upper()
                raise InputError(f"--log {log} would be written into what {option} names: give it another name")
            there = [each for each in named if each.exists() and parameter.name != "out"]
            paths |= {parameter.name.rstrip("_"): there if isinstance(value, list) else there[0]} if there else {}
        speaking.command, speaking.inputs, speaking.quiet = path, paths, speaking.quiet or quiet
        if log is not None:  # which nobody else may read: it holds tokens and addresses with passwords
            opened_log = os.open(log, os.O_WRONLY | os.O_APPEND | os.O_CREAT, 0o600)
            speaking.log = os.fdopen(opened_log, "a", encoding="utf-8", errors="backslashreplace")
            speaking.said(" ".join(["mrbokeh", *sys.argv[1:]]))
        with ExitStack() as held:
            if speaking.quiet:
                held.enter_context(redirect_stderr(held.enter_context(open(os.devnull, "w"))))
            held.enter_context(writing_alone(None if path in SHARING else _written_to(given)))
            callback(**given)

    command.callback = run


def _written_to(given: dict[str, Any]) -> Path | None:
    """Return OUT, or the scene whose stacks a command of `capture` works on in place."""
    out, scene = given.get("out"), given.get("scene")
    return (out or (scene if scene is not None and scene.is_dir() else None)) if _is_first() else None


class LazyGroup(TyperGroup):
    """A group that loads a sub-command's module when the sub-command is called (or completed, or asked for help)."""

    def __init__(self, **settings: Any) -> None:
        super().__init__(**settings)
        self.commands = {name: _placeholder(name, each.summary) for name, each in SUB_COMMANDS.items()}

    def resolve_command(self, ctx: Any, args: list[str]) -> Any:
        name, command, rest = super().resolve_command(ctx, args)
        if name in SUB_COMMANDS and rest and _is_first() and not {name, *rest} & SPEAK_FOR_THEMSELVES:
            begin(name)
        return name, command_of(name) if name in SUB_COMMANDS else command, rest


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
    wants_object, err, speaking = "--json" in sys.argv[1:], sys.stderr, Lock()
    with opened(), object_on_stdout(wants_object) as out:

        def ended(code: int, error: str) -> int:
            """Say the last words, unless another thread does, and return the exit code."""
            if not speaking.acquire(timeout=0.5):
                return code
            end_spinner()
            if error:
                _complain(error, err, stopped=code >= INTERRUPTED)
            try:
                if wants_object:
                    write_object(out, code, error)
                out.flush()
            except OSError:  # a pipe that nobody reads any more, or a full disk
                os.dup2(os.open(os.devnull, os.O_WRONLY), out.fileno())
                code = code or FAULT
            return code

        code = ended(*_run(_noted_interrupts(lambda: ended(INTERRUPTED, _stopped()))))
    sys.exit(code)


def _run(interrupted: list[int]) -> tuple[int, str]:
    """Run the command and return its exit code, and the sentence to end with or ""."""
    code: Any = 0
    try:
        code = app(standalone_mode=False)
    except SystemExit as left:
        code = left.code
    except NoArgsIsHelpError:  # it has shown the help
        return 2, ""
    except Exception as error:
        if mistake := mistake_in(error):
            return 2, mistake
        if not interrupted:
            if sys.argv[1:2] == ["--debug"]:
                raise
            return FAULT, fault_in(error)
        code = INTERRUPTED
    code = code if isinstance(code, int) else int(code is not None)
    return code, _stopped() if code >= INTERRUPTED else ""


def _is_first() -> bool:
    """Return whether this process speaks and writes for all that torchrun has started."""
    return os.environ.get("RANK", "0") == "0"


def _stopped() -> str:
    """Return what Ctrl-C left of the results, or "" where another process tells it."""
    if not _is_first():
        return ""
    written = ", ".join(map(str, channel().written()))
    return channel().kept or ("stopped: " + (f"finished before: {written}" if written else "nothing was written"))


def _noted_interrupts(last_words: Callable[[], object]) -> list[int]:
    """Return a list that fills with interrupts. Ctrl-C raises KeyboardInterrupt, but compilers may turn that into another error.

    A process whose threads still compute LATEST_S after it ends at once, with its last words.
    """
    noted: list[int] = []

    def leave_now() -> None:
        if signal.getsignal(signal.SIGINT) is note:
            last_words()
            remove_unfinished()
            os._exit(INTERRUPTED)

    def note(number: int, frame: FrameType | None) -> None:
        noted.append(number)
        late = Timer(LATEST_S, leave_now)
        late.daemon = True
        late.start()
        signal.default_int_handler(number, frame)

    if signal.getsignal(signal.SIGINT) is signal.default_int_handler:
        signal.signal(signal.SIGINT, note)
    return noted


def _complain(message: str, file: Any, *, stopped: bool) -> None:
    channel().said(message if stopped else f"error: {message}")
    with suppress(OSError):
        console = Console(file=file, soft_wrap=True, emoji=False)
        if not stopped:
            console.print("error:", style="bold red", end=" ")
        console.print(message, markup=False, highlight=False)


if __name__ == "__main__":
    main()
